"""The C libraries of the package, built at installation and loaded with ctypes, and the README as an index shows it.

All else is in pyproject.toml.
"""

import platform
import re
import shutil
from glob import glob
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

# No -ffast-math: NaN must stay NaN, so that it can be detected, and sums keep their order.
# -fno-wrapv takes back a flag of many Pythons: indices that may wrap around lengthen every loop over a matrix.
FLAGS = ["-std=c99", "-O3", "-fno-math-errno", "-fno-trapping-math", "-fno-wrapv", "-ffp-contract=fast"]
CORE = "kpirl_ocp.ocp.interior_point._core"
METHOD = "kpirl_ocp/ocp/interior_point/c"
PARTS = ("algebra", "method", "globalisation", "library")
FOLDERS = [METHOD, *(f"{METHOD}/{part}" for part in PARTS), "kpirl_ocp/ocp/sensitivity/c"]
SOURCES = sorted(path for folder in FOLDERS for path in glob(f"{folder}/*.c"))
HEADERS = sorted(path for folder in FOLDERS for path in glob(f"{folder}/*.h"))
# One build for each level of the x86-64 psABI; the package loads the best one that the processor runs.
LEVELS = {"": []}
if platform.machine() in ("x86_64", "AMD64"):
    LEVELS |= {level: [f"-march=x86-64{level.replace('_', '-')}"] for level in ("_v3", "_v4")}
LIBRARIES = [
    Extension(
        f"{CORE}{level}",
        SOURCES,
        include_dirs=FOLDERS,
        depends=HEADERS,
        libraries=["m"],
        extra_compile_args=[*FLAGS, *more],
    )
    for level, more in LEVELS.items()
]


class BuildLibraries(build_ext):
    """Shared libraries under one name for every Python: they hold plain C, no Python module."""

    def build_extensions(self) -> None:
        """Compile. Raises CompileError, which becomes the last line, if there is no compiler."""
        compiler = self.compiler.compiler_so[0]
        if shutil.which(compiler) is None:
            remedy = "install one (on Debian and Ubuntu: apt install build-essential), or install from a wheel"
            raise CompileError(f"kpirl_ocp is built with a C compiler, and there is no {compiler!r}: {remedy}.")
        super().build_extensions()

    def get_ext_filename(self, fullname: str) -> str:
        """Path of a library below the package's root."""
        return str(Path(*fullname.split(".")).with_suffix(".so"))

    def get_export_symbols(self, ext: Extension) -> list[str]:
        """No PyInit function."""
        return ext.export_symbols


class PlatformWheel(bdist_wheel):
    """One wheel a platform, for every Python 3."""

    def get_tag(self) -> tuple[str, str, str]:
        """Tags of interpreter, ABI and platform."""
        interpreter, abi, platform = super().get_tag()
        return (interpreter, abi, platform) if self.root_is_pure else ("py3", "none", platform)


def description(repository: str | None) -> str:
    """The README for a package index, which cannot follow paths.

    With the address of the repository, pictures and links lead to the files of this version there; without one,
    pictures are left out with their captions, and links become text.
    """
    text = Path("README.md").read_text(encoding="utf-8")
    picture, link = r"!\[([^\]]*)\]\((?!https?:)([^)]*)\)", r"(?<!!)\[([^\]]*)\]\((?!https?:)([^)]*)\)"
    if repository is None:
        text = re.sub(picture + r"\n\n\*.*?\*\n\n", "", text, flags=re.DOTALL)
        return re.sub(link, r"\1", text)
    (version,) = re.findall(r'= "(.*)"', Path("kpirl_ocp/version.py").read_text(encoding="utf-8"))
    text = re.sub(picture, rf"![\1]({repository}/raw/v{version}/\2)", text)
    return re.sub(link, rf"[\1]({repository}/blob/v{version}/\2)", text)


def repository() -> str | None:
    """The line `Repository = "https://.."` of the project's URLs; None where there is none."""
    found = re.findall(r'^Repository = "(.*?)/?"$', Path("pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    return found[0] if found else None


setup(
    ext_modules=LIBRARIES,
    cmdclass={"build_ext": BuildLibraries, "bdist_wheel": PlatformWheel},
    long_description=description(repository()),
    long_description_content_type="text/markdown",
)
