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
from typing import IO, Any, Dict, Iterable, List, Literal, Mapping, Optional, Sequence, Tuple, Union

from . import cameras as _cameras
from ._camera import Camera
from ._errors import Error, QualityError, argument_error, from_message, local_name, make
from ._paths import Path, encoded
from ._progress import Callback, Progress, Reporting
from ._scene import Profile, SpzAxes

Size = Union[None, str, Tuple[int, int]]
Number = Union[None, float, str]
Cameras = Union[None, Path, Camera, Iterable[Camera]]

_CLASSES = {2: "bad_argument", 3: "read_failed", 4: "bad_value", 5: "gate_failed", 6: "pages_missing"}
_NO_OPTIONS = {"src", "dst", "asset", "progress", "report"}  # they take another way


def convert(src: Union[Path, Sequence[Path]], dst: Path, *, overwrite: bool = False, progress: Progress = None,
            cameras: Cameras = None, from_: Optional[str] = None, to: Optional[str] = None, skip_unknown_extensions: bool = False,
            spz_axes: Optional[SpzAxes] = None, spz_version: Optional[int] = None, merge: bool = False, axes: Optional[str] = None,
            to_axes: Optional[str] = None, translate: Any = None, rotate: Any = None, scale: Any = None, crop: Any = None,
            min_opacity: Optional[float] = None, max_count: Number = None, level_of_detail: Optional[int] = None,
            aa_mode: Optional[Literal["classic", "mip", "mip-splatting", "undeclared"]] = None, low_pass: Optional[float] = None,
            colour_space: Optional[Literal["srgb", "linear", "undeclared"]] = None, metres_per_unit: Optional[float] = None,
            crs: Optional[str] = None, max_expansion: Number = None, keep_order: bool = False, sh_degree: Optional[int] = None,
            on_bad: Optional[Literal["refuse", "drop", "repair"]] = None, strict: bool = False, allow_rounding: bool = False,
            depth_map: Optional[Literal["linear", "log"]] = None, profile: Optional[Profile] = None,
            archive_step: Optional[float] = None, target_psnr: Optional[float] = None, target_size: Number = None,
            level: Optional[int] = None, keep_permutation: bool = False, chunk_size: Optional[int] = None, file_scales: bool = False,
            lod: bool = False, lod_quality: Optional[Literal["fast", "best"]] = None,
            backend: Optional[Literal["cpu", "cuda"]] = None, near: Optional[float] = None, far: Optional[float] = None,
            memory: Number = None, scratch: Optional[Path] = None, no_sync: bool = False,
            threads: Optional[int] = None) -> Dict[str, Any]:
    """Converts a splat file; the ending of `dst` names the format. Several inputs are merged.

    Parameters
    ----------
    cameras : path, or cameras, optional
        An .rgs declares the depth range that these see.
    progress : True or a function
        A bar, or ``function(stage, done, total, unit)``.
    others
        As in ``rgs-convert --help``, with underscores: ``profile="archive:high"``, ``lod=True``, ``sh_degree=1``,
        ``crop=(0, 0, 0, 1, 2, 1)``, ``on_bad="repair"``. Options for whole folders belong to the program alone.

    Returns
    -------
    dict
        The report: docs/user/CONVERT_JSON.md.

    >>> done = convert(examples / "scene.ply", folder / "small.rgs", sh_degree=1, min_opacity=0.05)
    >>> done["output"]["sh_degree"], done["filtered"] + done["output"]["gaussians"]
    (1, 2000)
    """
    options = {**locals()}
    single = isinstance(src, (str, bytes, os.PathLike))
    sources: List[Path] = [src] if single else list(src)  # type: ignore[arg-type, list-item]
    if any(os.path.isdir(source) for source in sources):
        raise argument_error("convert() takes one scene; use the program rgs-convert for a folder")
    options["merge"] = merge or len(sources) > 1
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "overwrite": bool(overwrite), "cameras": camera_file})
        return _json(_run("rgs-convert", [*arguments, b"--json", b"--", *map(_name, sources), _name(dst)], progress))


def prune(src: Path, dst: Path, cameras: Cameras, *, keep: Union[None, int, float, str] = None, overwrite: bool = False,
          progress: Progress = None, split: Optional[Literal["train", "test"]] = None, view: Union[None, int, str] = None,
          size: Size = None, min_contribution: Optional[float] = None, score: Optional[Literal["sum", "max"]] = None,
          scores: Optional[Path] = None, low_pass: Optional[float] = None, aa_mode: Optional[Literal["classic", "mip"]] = None,
          max_expansion: Number = None, spz_axes: Optional[SpzAxes] = None, no_sync: bool = False,
          threads: Optional[int] = None) -> Dict[str, Any]:
    """Keeps the Gaussians that contribute most to the views of `cameras`, as a .ply or an .rgs.

    Parameters
    ----------
    keep : int, float or str
        A count, a share from 0 to 1, or "20%". Alternatively `min_contribution`.
    others
        As in ``rgs-prune --help``: ``split="train"``, ``score="max"``, ``size=(640, 480)``, ...

    >>> prune(examples / "scene.rgs", folder / "half.rgs", examples / "cameras.json", keep=0.5)["output"]["gaussians"]
    1000
    """
    options = {**locals()}
    given: Any = keep
    if hasattr(given, "tolist"):  # of NumPy
        keep = given.tolist()
    if isinstance(keep, float):
        if not 0 <= keep <= 1:
            raise argument_error(f"keep is a share (float, 0 to 1) or a count (int), not {keep}")
        keep = f"{100 * keep:.12g}%"
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "size": _size(size), "keep": keep, "overwrite": bool(overwrite), "cameras": camera_file})
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
          report: Optional[Path] = None, overwrite: bool = False, progress: Progress = None, photos: Optional[Path] = None,
          also: Union[None, Path, List[Path]] = None, spz_axes: Optional[SpzAxes] = None,
          split: Optional[Literal["train", "test", "all"]] = None, size: Size = None, views: Optional[int] = None,
          worst: Optional[int] = None, depth: bool = False, measures: Union[None, str, Tuple[str, ...]] = None, video: bool = False,
          fps: Optional[int] = None, no_render: bool = False, no_attribution: bool = False, no_distances: bool = False,
          compare_scales: bool = False, backend: Optional[Literal["auto", "cpu", "cuda"]] = None, threads: Optional[int] = None,
          max_expansion: Number = None) -> Audit:
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
    others
        As in ``rgs-audit --help``: ``photos="photos/"``, ``size=(640, 480)``, ``no_render=True``, ...

    >>> found = audit(examples / "scene.ply", examples / "scene.rgs", cameras=examples / "cameras.json", fail_below={"psnr": 40})
    >>> found.holds, found["asset"]["gaussians"]
    (True, 2000)
    """
    options = {**locals()}
    if os.path.isdir(src) or os.path.isdir(asset):
        raise argument_error("audit() takes one pair of files; use the program rgs-audit for folders")
    if isinstance(fail_below, Mapping):
        fail_below = ",".join(f"{name.replace('_', '-')}={float(limit)!r}" for name, limit in fail_below.items()) or None
    with _camera_file(cameras) as camera_file:
        arguments = _arguments({**options, "size": _size(size), "fail_below": fail_below, "overwrite": bool(overwrite),
                                "cameras": camera_file})
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


def _size(size: Size) -> Optional[str]:
    return "x".join(map(str, size)) if isinstance(size, tuple) else size


def _arguments(options: Mapping[str, Any]) -> List[bytes]:
    arguments: List[bytes] = []
    for name, value in options.items():
        if name in _NO_OPTIONS or value is None or value is False:
            continue
        option = b"--" + name.rstrip("_").replace("_", "-").encode()  # from_
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
