"""The exceptions."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from typing import Any, Dict, Optional, Type

from ._paths import Path, encoded, is_address, shown


class Error(Exception):
    """Base of all RoofGS errors. Each subclass is also the standard exception of its kind.

    Attributes
    ----------
    code : str
        Stable name of the failure: ``"checksum_mismatch"``, ``"bad_camera"``, ... (``Errc`` in ``rgs/result.hpp``).
    file : str or None
        The file, or the address without user, password and query.
    offset : int or None
        Byte of the file.
    expected, found : int or None
        The expected and actual count, size or hash.
    errno : int or None
        Of the failed system call.
    hint : str
        What to do; may be empty.

    >>> import roofgs
    >>> try:
    ...     roofgs.load("no-such-file.rgs")
    ... except roofgs.Error as error:
    ...     print(error.code, error.file, isinstance(error, FileNotFoundError))
    open_failed no-such-file.rgs True
    """

    code: str
    file: Optional[str]
    offset: Optional[int]
    expected: Optional[int]
    found: Optional[int]
    errno: Any  # OSError does not allow None
    hint: str

    def __init__(self, message: str = "", *, code: str = "internal", file: Optional[str] = None,
                 offset: Optional[int] = None, expected: Optional[int] = None, found: Optional[int] = None,
                 errno: Optional[int] = None, hint: str = "") -> None:
        Exception.__init__(self, message)
        self.message = message
        self.code = code
        self.file = file
        self.offset = offset
        self.expected = expected
        self.found = found
        self.errno = errno
        self.hint = hint

    def __str__(self) -> str:
        text = f"{self.file}: {self.message}" if self.file else self.message
        text += f" [{self.code}]"
        return f"{text}\n  hint: {self.hint}" if self.hint else text

    # OSError would pickle (errno, text) alone.
    def __reduce__(self) -> "tuple[Any, ...]":
        return _again, (type(self), self.message, self.code, self.file, self.offset, self.expected, self.found,
                        self.errno, self.hint)


def _again(kind: Type[Error], message: str, code: str, file: Optional[str], offset: Optional[int],
           expected: Optional[int], found: Optional[int], errno: Optional[int], hint: str) -> Error:
    return kind(message, code=code, file=file, offset=offset, expected=expected, found=found, errno=errno, hint=hint)


class InternalError(Error, RuntimeError):
    """A bug in RoofGS."""


class ArgumentError(Error, ValueError):
    """An argument is out of its documented range, or a camera is invalid."""


class UnavailableError(Error, RuntimeError):
    """There is no such device, or this build cannot use it."""


# OSError.__new__ counts its arguments.
class _SystemError(Error, OSError):
    def __new__(cls, *args: Any, **keywords: Any) -> "_SystemError":
        return OSError.__new__(cls)


class InputOutputError(_SystemError):
    """Reading or writing failed."""


class MissingFileError(InputOutputError, FileNotFoundError):
    """The file does not exist."""


class OutputExistsError(InputOutputError, FileExistsError):
    """The output exists, and ``overwrite=True`` was not given."""


class DeviceError(Error, RuntimeError):
    """A call to the GPU driver failed."""


class OutOfMemoryError(Error, MemoryError):
    """The host or the device is out of memory."""


class FormatError(Error, ValueError):
    """A file is damaged or of an unsupported kind."""


class QualityError(Error):
    """A condition of ``audit(fail_below=...)`` does not hold. ``report`` is the audit."""

    report: Any = None

    def __reduce__(self) -> "tuple[Any, ...]":
        return (*super().__reduce__(), {"report": self.report})


class IncompleteError(Error, ValueError):
    """The requested data lie in the missing end of a file with levels of detail."""


_KINDS = {
    "internal": InternalError,
    "cancelled": InternalError,
    "bad_argument": ArgumentError,
    "bad_camera": ArgumentError,
    "unavailable": UnavailableError,
    "output_exists": OutputExistsError,
    "device_failed": DeviceError,
    "device_out_of_memory": OutOfMemoryError,
    "host_out_of_memory": OutOfMemoryError,
    "gate_failed": QualityError,
    "pages_missing": IncompleteError,
    "open_failed": InputOutputError,
    "read_failed": InputOutputError,
    "write_failed": InputOutputError,
    "output_unusable": InputOutputError,
}
_ENOENT = 2
_NOT_FOUND = 404  # of HTTP
_NAMES = {"DecodeLimits::": "", "StreamPoolOptions::": "", "Backend::cpu": "device='cpu'", "Backend::cuda": "device='cuda'"}
_FLAGS = {"overwrite", "strict", "allow_rounding", "merge", "lod", "keep_permutation", "keep_order"}


def _as_python(text: str) -> str:
    """Rewrites program options as keyword arguments: --overwrite becomes overwrite=True."""

    def argument(match: "re.Match[str]") -> str:
        name = "from_" if match[1] == "from" else match[1].replace("-", "_")
        if match[2]:
            return f"{name}={match[2]!r}"
        return f"{name}=True" if name in _FLAGS and not match[0].endswith("=") else f"{name}="

    values = r"(?:[ =](drop|repair|refuse|packed|direct|archive(?::[a-z]+)?)\b|=)?"
    text = re.sub(r"--([a-z][a-z-]*[a-z])" + values, argument, text)
    for native, here in _NAMES.items():
        text = text.replace(native, here)
    return text


def make(code: str, message: str, hint: str = "", file: Optional[str] = None, offset: Optional[int] = None,
         expected: Optional[int] = None, found: Optional[int] = None, errno: Optional[int] = 0) -> Error:
    """The exception for a library failure."""
    kind: Type[Error] = _KINDS.get(code, FormatError)
    if kind is InputOutputError and (errno == _ENOENT or (found == _NOT_FOUND and file is not None and is_address(file))):
        kind = MissingFileError
    return kind(_as_python(message), code=code, file=None if file is None else shown(file), offset=offset, expected=expected, found=found,
                errno=errno or None, hint=_as_python(hint))


def from_message(error: Dict[str, Any], file: Optional[str]) -> Error:
    """The exception for an error of the library or of a program, as of RGS_MESSAGES=json."""
    return make(error["code"], error["message"], error["hint"], file, error["offset"], error["expected"], error["found"], error["system"])


def argument_error(message: str, file: Optional[str] = None) -> Error:
    return make("bad_argument", message, file=file)


def local_name(path: Path) -> bytes:
    """The bytes of a path; addresses are rejected."""
    name = encoded(path)
    if is_address(name):
        raise argument_error("is an address; only roofgs.load() and StreamedScene read addresses", shown(name))
    return name
