"""Reads of files that anybody may have written: regular ones, whose size is known beforehand."""

import errno
import io
import math
import stat
import zipfile
from pathlib import Path

import numpy as np

LARGEST = 2**30  # bytes of a file that is read at once


def read_bytes(path: Path, largest: int = LARGEST) -> bytes:
    """Returns the content of a regular file; see `check_regular`."""
    check_regular(path, largest)
    return path.read_bytes()


def check_regular(path: Path, largest: int = LARGEST) -> None:
    """Raises OSError for a pipe or device, which may never end, and for more than `largest`."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode) or status.st_size > largest:
        reason = f"is a folder, a pipe or a device, or larger than {largest >> 10} KiB"
        raise OSError(errno.EINVAL, reason, str(path))


def read_arrays(content: bytes) -> dict[str, np.ndarray]:
    """Reads the arrays of an uncompressed .npz by name.

    Raises ValueError, BadZipFile and the like before it makes an array larger than the file.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        sizes = [one.file_size for one in members if one.compress_type == zipfile.ZIP_STORED]
        if len(sizes) < len(members) or sum(sizes) > len(content):
            raise ValueError("its arrays are compressed or overlap")
        return {one.filename.removesuffix(".npy"): _array(archive.read(one)) for one in members}


def _array(content: bytes) -> np.ndarray:
    file = io.BytesIO(content)
    np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    if math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError("an array is not as large as its header says")
    return np.load(io.BytesIO(content), allow_pickle=False)
