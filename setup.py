"""The C libraries of the package, built at installation and loaded with ctypes, and the README as an index shows it.

All else is in pyproject.toml.
"""

import platform
import re
from glob import glob
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

# No -ffast-math: NaN must stay NaN, so that it can be detected, and sums keep their order.
FLAGS = ["-std=c99", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
CORE = "kpirl_ocp.ocp.interior_point._core"
METHOD = "kpirl_ocp/ocp/interior_point/c"
FOLDERS = [METHOD, f"{METHOD}/algebra", f"{METHOD}/method", "kpirl_ocp/ocp/sensitivity/c"]
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


def description() -> str:
    """The README without pictures, their captions and links into the repository, which an index cannot follow."""
    text = Path("README.md").read_text(encoding="utf-8")
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)\n\n\*.*?\*\n\n", "", text, flags=re.DOTALL)
    return re.sub(r"\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", text)


setup(
    ext_modules=LIBRARIES,
    cmdclass={"build_ext": BuildLibraries, "bdist_wheel": PlatformWheel},
    long_description=description(),
    long_description_content_type="text/markdown",
)
