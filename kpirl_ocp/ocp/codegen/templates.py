"""The hand-written C of an exported folder, and how it is renamed."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files

from kpirl_ocp.errors import ProblemError

PREFIX = "kpirl_mpc"
LICENCE = "/* SPDX-License-Identifier: MIT */"

_KEYWORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool complex
imaginary true false nullptr constexpr typeof alignas alignof asm and bitand bitor catch class compl concept consteval
constinit decltype delete explicit export friend module mutable namespace new noexcept not operator or private protected
public requires template this throw try typeid typename using virtual wchar xor std main
"""
# Of the headers that exported C includes, POSIX's additions among them.
_LIBRARY = """
abort abs acos acosh asin asinh assert atan atan2 atanh atexit atof atoi atol atoll bsearch calloc cbrt ceil clock
copysign cos cosh ctime difftime div drem erf erfc errno exit exp exp2 expm1 fabs fclose fdim feof fflush fgets fma
fmax fmin fmod fopen fprintf fputs fread free frexp fscanf fseek ftell fwrite gamma getc getchar getenv gets gmtime
hypot ilogb index infinity isfinite isinf isnan isnormal j0 j1 jn labs ldexp ldiv lgamma llabs lldiv llrint llround
localtime log log10 log1p log2 logb lrint lround malloc memchr memcmp memcpy memmove memset mktime modf nan
nearbyint nextafter null offsetof perror pow printf putc putchar puts qsort raise rand realloc remainder remove
remquo rename rewind rindex rint round scalb scalbln scalbn scanf signal signbit signgam significand sin sinh
snprintf sprintf sqrt srand sscanf stderr stdin stdout strcat strchr strcmp strcpy strcspn strdup strerror strlen
strncat strncmp strncpy strpbrk strrchr strspn strstr strtod strtof strtok strtol strtoll strtoul system tan tanh
tgamma time tmpfile tolower toupper trunc ungetc vprintf y0 y1 yn
"""
RESERVED = frozenset(f"{_KEYWORDS} {_LIBRARY}".split())


def read(name: str) -> str:
    """The text of a file in `ocp/export/c`."""
    return (files("kpirl_ocp.ocp") / "export" / "c" / name).read_text()


def core_files() -> dict[str, str]:
    """The C files of the interior-point method that an export consists of, name -> text."""
    folder = files("kpirl_ocp.ocp") / "interior_point" / "c"
    of_python, of_constants = "library", f"{PREFIX}_dimensions."  # the latter is made for constants here
    folders = [folder, *(path for path in folder.iterdir() if path.is_dir() and path.name != of_python)]
    files_in = (path for each in folders for path in each.iterdir() if path.is_file())
    found = [path for path in files_in if not path.name.startswith(of_constants)]
    return {path.name: path.read_text() for path in sorted(found, key=lambda path: path.name)}


def renamed(text: str, prefix: str) -> str:
    """Text whose names begin with another prefix, so that two controllers can be linked into one program."""
    return text.replace(PREFIX, prefix).replace(PREFIX.upper(), prefix.upper())


def check_prefix(prefix: str) -> str:
    """Raise ProblemError unless C names may begin with this."""
    if not (prefix.isidentifier() and prefix.isascii() and prefix == prefix.lower() and not prefix.startswith("_")):
        raise ProblemError(
            f"prefix must be a lower-case C name such as 'left_arm', for files and functions; got {prefix!r}."
        )
    if prefix in RESERVED:
        raise _taken(prefix, "C, C++ or their libraries have")
    return prefix


def check_names(prefix: str, texts: Iterable[str]) -> None:
    """Raise ProblemError if C files (of the prefix `PREFIX`) call something else by this prefix, a type there."""
    for text in texts:
        if prefix != PREFIX and prefix in _names(text):
            raise _taken(prefix, "the exported code has")


def _names(text: str) -> set[str]:
    """Names in C that are not members of structures."""
    text = re.sub(r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\])*"', " ", text, flags=re.DOTALL)
    text = re.sub(r"\b(?:struct|union)\s*\w*\s*\{[^}]*\}", " ", text)
    return set(re.findall(r"(?<![\w.>])[a-z]\w*", text))


def _taken(prefix: str, who: str) -> ProblemError:
    return ProblemError(
        f"prefix must be a name of your own such as 'left_arm'; {who} something called {prefix!r}, so that it would "
        "not compile."
    )
