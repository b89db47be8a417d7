"""convert(), prune() and audit(): the programs of RoofGS as functions.

They run rgs-convert, rgs-prune and rgs-audit, which report progress and errors as JSON on standard error
(converter/tool/console.hpp). A process of its own does not hold the GIL, ends at once on Ctrl-C and leaves no unfinished file.
"""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import html
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from pathlib import Path as FilePath
from typing import IO, Any, Dict, Iterable, List, Mapping, Optional, Sequence, Tuple, Union

from . import cameras as _cameras
from ._camera import Camera
from ._errors import Error, QualityError, argument_error, from_message, local_name, make
from ._paths import Path, encoded
from ._progress import Callback, Progress, Reporting

Cameras = Union[None, Path, Camera, Iterable[Camera]]

_CLASSES = {2: "bad_argument", 3: "read_failed", 4: "bad_value", 5: "gate_failed", 6: "pages_missing"}
# Options that print something else or take many scenes.
_NOT_HERE = {"json", "quiet", "help", "version", "list", "report", "shard", "jobs", "junit", "audit", "keep_going"}


def convert(src: Union[Path, Sequence[Path]], dst: Path, *, overwrite: bool = False, progress: Progress = None,
            cameras: Cameras = None, **options: Any) -> Dict[str, Any]:
    """Converts a splat file; the ending of `dst` names the format. Several inputs are merged.

    Parameters
    ----------
    cameras : path, or cameras, optional
        An .rgs declares the depth range that these see.
    progress : True or a function
        A bar, or ``function(stage, done, total, unit)``.
    options
        Those of ``rgs-convert --help``, with underscores: ``profile="archive:high"``, ``lod=True``, ``sh_degree=1``,
        ``crop=(0, 0, 0, 1, 2, 1)``, ``on_bad="repair"``. Options for whole folders belong to the program alone.

    Returns
    -------
    dict
        The report: docs/user/CONVERT_JSON.md.

    >>> done = convert(examples / "scene.ply", folder / "small.rgs", sh_degree=1, min_opacity=0.05)
    >>> done["output"]["sh_degree"], done["filtered"] + done["output"]["gaussians"]
    (1, 2000)
    """
    single = isinstance(src, (str, bytes, os.PathLike))
    sources: List[Path] = [src] if single else list(src)  # type: ignore[arg-type, list-item]
    if any(os.path.isdir(source) for source in sources):
        raise argument_error("convert() takes one scene; use the program rgs-convert for a folder")
    if len(sources) > 1:
        options.setdefault("merge", True)
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "overwrite": bool(overwrite), "cameras": camera_file}, _NOT_HERE)
        return _json(_run("rgs-convert", [*arguments, b"--json", b"--", *map(_name, sources), _name(dst)], progress))


def prune(src: Path, dst: Path, cameras: Cameras, *, keep: Union[None, int, float, str] = None, overwrite: bool = False,
          progress: Progress = None, **options: Any) -> Dict[str, Any]:
    """Keeps the Gaussians that contribute most to the views of `cameras`, as a .ply or an .rgs.

    Parameters
    ----------
    keep : int, float or str
        A count, a share from 0 to 1, or "20%". Alternatively `min_contribution`.
    options
        Those of ``rgs-prune --help``: ``split="train"``, ``score="max"``, ``size=(640, 480)``, ...

    >>> prune(examples / "scene.rgs", folder / "half.rgs", examples / "cameras.json", keep=0.5)["output"]["gaussians"]
    1000
    """
    given: Any = keep
    if hasattr(given, "tolist"):  # of NumPy
        keep = given.tolist()
    if isinstance(keep, float):
        if not 0 <= keep <= 1:
            raise argument_error(f"keep is a share (float, 0 to 1) or a count (int), not {keep}")
        keep = f"{100 * keep:.12g}%"
    if isinstance(options.get("size"), tuple):
        options["size"] = "x".join(str(side) for side in options["size"])
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "keep": keep, "overwrite": bool(overwrite), "cameras": camera_file}, _NOT_HERE)
        return _json(_run("rgs-prune", [*arguments, b"--json", b"--", _name(src), _name(dst)], progress))


class Audit(Dict[str, Any]):
    """The result of :func:`audit`: the object of docs/user/AUDIT_JSON.md, with common fields as attributes."""

    @property
    def verdict(self) -> str:
        """One sentence."""
        return str(self["verdict"]["headline"])

    @property
    def grade(self) -> str:
        """"identical", "no_visible_loss", "close", "visible", "poor" or "unrated"."""
        return str(self["verdict"]["grade"])

    @property
    def holds(self) -> bool:
        """Whether all conditions hold."""
        return bool(self["gate"]["holds"])

    @property
    def measured(self) -> Mapping[str, Optional[float]]:
        """By condition: "psnr", "ratio", ... None is infinite; unmeasured ones are absent."""
        values: Mapping[str, Optional[float]] = self["measured"]
        return values

    def __repr__(self) -> str:
        return f"<roofgs.Audit: {self.verdict}>"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{html.escape(name)}</td><td>{'infinite' if value is None else f'{value:.6g}'}</td></tr>"
                       for name, value in self.measured.items())
        detail = html.escape(str(self["verdict"]["detail"]))
        return f"<p><b>{html.escape(self.verdict)}</b><br>{detail}</p><table>{rows}</table>"


def audit(src: Path, asset: Path, *, cameras: Cameras = None, fail_below: Union[None, str, Mapping[str, float]] = None,
          report: Optional[Path] = None, overwrite: bool = False, progress: Progress = None, **options: Any) -> Audit:
    """Measures what a conversion cost and lost: sizes, every attribute, pictures.

    Parameters
    ----------
    cameras : path, or cameras, optional
        Views to compare; by default eight on a circle around the scene, and the four worst of a search.
    fail_below : dict or str
        Conditions: ``{"psnr": 50, "loss": 0.03}``. One that fails raises :class:`QualityError`, whose `report` is the
        audit.
    report : path, optional
        Also write an HTML page.
    options
        Those of ``rgs-audit --help``: ``photos="photos/"``, ``size=(640, 480)``, ``no_render=True``, ...

    >>> found = audit(examples / "scene.ply", examples / "scene.rgs", cameras=examples / "cameras.json", fail_below={"psnr": 40})
    >>> found.holds, found["asset"]["gaussians"]
    (True, 2000)
    """
    if os.path.isdir(src) or os.path.isdir(asset):
        raise argument_error("audit() takes one pair of files; use the program rgs-audit for folders")
    if isinstance(fail_below, Mapping):
        fail_below = ",".join(f"{name.replace('_', '-')}={float(limit)!r}" for name, limit in fail_below.items()) or None
    if isinstance(options.get("size"), tuple):
        options["size"] = "x".join(str(side) for side in options["size"])
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "fail_below": fail_below, "overwrite": bool(overwrite), "cameras": camera_file}, _NOT_HERE)
        if report is not None:
            arguments += [b"--report", _name(report)]
        code, out, error = _run_to_end("rgs-audit", [*arguments, b"--json", b"-", b"--", _name(src), _name(asset)], progress)
    if code == 5 and out:
        found = Audit(_json(out))
        failed = [f"{each['name']} {each.get('found')} against {each['limit']}" for each in found["gate"]["conditions"]
                  if not each["holds"]]
        gate = QualityError(f"a condition does not hold: {'; '.join(failed)}", code="gate_failed",
                            file=os.fsdecode(encoded(asset)))
        gate.report = found
        raise gate
    if code != 0:
        raise error
    return Audit(_json(out))


# ---- running programs


def find_program(name: str) -> str:
    """A program of RoofGS: in the folder $ROOFGS_PROGRAMS, in this package, or on $PATH."""
    folders = [os.environ.get("ROOFGS_PROGRAMS"), str(FilePath(__file__).parent / "bin")]
    for folder in folders:
        if folder and os.access(os.path.join(folder, name), os.X_OK):
            return os.path.join(folder, name)
    found = shutil.which(name)
    if found is None:
        raise make("unavailable", f"the program {name} is not installed: add its folder to PATH or set ROOFGS_PROGRAMS")
    return found


def _name(path: Path) -> bytes:
    """A path as an argument that is read neither as an option nor as a standard stream."""
    name = local_name(path)
    return b"./" + name if name.startswith(b"-") else name


def _arguments(options: Mapping[str, Any], not_here: "set[str]") -> List[bytes]:
    arguments: List[bytes] = []
    for name, value in options.items():
        if name in not_here:
            raise argument_error(f"{name}= is an option of the program alone")
        if value is None or value is False:
            continue
        option = b"--" + name.replace("_", "-").encode()
        values = value if isinstance(value, list) else [value]
        for each in values:
            arguments.append(option if each is True else option + b"=" + _text(each))
    return arguments


def _text(value: Any) -> bytes:
    if isinstance(value, (str, bytes, os.PathLike)):
        return encoded(value)
    if isinstance(value, tuple):
        return b",".join(_text(each) for each in value)
    if hasattr(value, "tolist"):  # of NumPy
        plain = value.tolist()
        return _text(tuple(plain) if isinstance(plain, list) else plain)
    return repr(value).encode()


class _camera_file:
    """The path of a camera file; cameras in memory are written to a temporary one."""

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._folder: Optional["tempfile.TemporaryDirectory[str]"] = None

    def __enter__(self) -> Optional[Path]:
        if self._cameras is None or isinstance(self._cameras, (str, bytes, os.PathLike)):
            return self._cameras
        self._folder = tempfile.TemporaryDirectory(prefix="roofgs-")
        path = os.path.join(self._folder.name, "cameras.json")
        _cameras.save(path, self._cameras)
        return path

    def __exit__(self, *_: object) -> None:
        if self._folder:
            self._folder.cleanup()


def _json(text: bytes) -> Dict[str, Any]:
    value: Dict[str, Any] = json.loads(text)
    return value


def _run(name: str, arguments: Sequence[bytes], progress: Progress) -> bytes:
    code, out, error = _run_to_end(name, arguments, progress)
    if code != 0:
        raise error
    return out


def _run_to_end(name: str, arguments: Sequence[bytes], progress: Progress) -> Tuple[int, bytes, Error]:
    """Exit code, standard output and the exception for a failure."""
    command: List[Any] = [find_program(name), *arguments]
    environment = {**os.environ, "RGS_MESSAGES": "json"}
    output: List[bytes] = []
    heard = _Messages()
    with Reporting(progress) as callback:
        process = None
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                       env=environment)
            assert process.stdout is not None and process.stderr is not None
            reader = threading.Thread(target=_read, args=(process.stdout, output), daemon=True)
            reader.start()
            for line in process.stderr:
                heard.take(line, callback)
            reader.join()
            code = process.wait()
        except BaseException:  # Ctrl-C, or an exception from the callback
            if process is not None:
                _end(process)
            raise
        finally:
            if process is not None:
                for stream in (process.stdout, process.stderr):
                    if stream is not None and process.poll() is not None:
                        stream.close()
    return code, b"".join(output), heard.error(name, code)


def _read(stream: IO[bytes], into: List[bytes]) -> None:
    into.append(stream.read())


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Stops a program, which removes its unfinished outputs; another Ctrl-C kills it."""
    process.terminate()
    process.send_signal(signal.SIGCONT)  # a stopped one would not hear it
    try:
        process.wait()
    except KeyboardInterrupt:
        process.kill()
        process.wait()
        raise


class _Messages:
    """Reads a program's standard error."""

    def __init__(self) -> None:
        self._error: Optional[Dict[str, Any]] = None
        self._others: List[str] = []

    def take(self, line: bytes, callback: Optional[Callback]) -> None:
        try:
            message = json.loads(line)
            progress, error = message.get("progress"), message.get("error")
        except (ValueError, AttributeError):
            self._others.append(line.decode(errors="replace").strip())
            return
        if error:
            self._error = self._error or error
        elif progress and callback:
            callback(progress["stage"], progress["done"], progress["total"], progress["unit"])

    def error(self, name: str, code: int) -> Error:
        if self._error is not None:
            return from_message(self._error, self._error["file"])
        if code < 0:
            return make("internal", f"{name} was ended by signal {-code}")
        return make(_CLASSES.get(code, "internal"), "\n".join(self._others) or f"{name} failed with exit code {code}")
