"""Folders of pictures as videos: PNG or JPEG, in the order of the numbers in their names."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from kpirl_ocp.errors import FileError
from kpirl_ocp.sizes import check_file

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural_order(path: Path) -> tuple[tuple[int, int, str], ...]:
    """A key that sorts frame2 before frame10, whatever text surrounds the numbers."""
    parts = re.split(r"(\d+)", path.stem.lower())
    return tuple((1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts)


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files with one of the suffixes, in capitals or not, in their order; none that is hidden (`._1.png`)."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(found, key=natural_order)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder in their order. Raises FileError if there are none."""
    paths = files_in(folder, PICTURE_SUFFIXES)
    if not paths:
        raise FileError(f"the folder {folder} holds no PNG or JPEG pictures: give one that does, or a video.")
    return paths


def iterate_pictures(folder: Path) -> Iterator[NDArray[np.uint8]]:
    """The pictures (H, W, 3) RGB of a folder one by one, upright as the camera noted (EXIF).

    Raises FileError if there are none, or one cannot be read or has another size.
    """
    shape = None
    for path in pictures_in(folder):
        image = decode_picture(_content(path), str(path))
        shape = shape or image.shape
        if image.shape != shape:
            raise FileError(f"the images in {folder} differ in size: {path.name} is {image.shape[1::-1]} pixels.")
        yield image


def _content(path: Path) -> bytes:
    try:
        check_file(path)
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise FileError(f"{path} cannot be read as an image: {error}") from error


def decode_picture(content: bytes, place: str) -> NDArray[np.uint8]:
    """The picture (H, W, 3) RGB in a PNG or JPEG file, upright as the camera noted (EXIF).

    Raises FileError, naming `place`, for more than 89 million pixels (Pillow's limit), and for any other content.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            Image.open(io.BytesIO(content), formats=("PNG", "JPEG")).close()  # reads only the header
    except UnidentifiedImageError as error:  # whose own words name an object of Python
        raise FileError(f"{place} cannot be read as an image: it is no PNG or JPEG, whatever its name says.") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise FileError(f"{place} cannot be read as an image: {error}") from error
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise FileError(f"{place} cannot be read as an image: it is damaged.")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
