"""Exceptions. SPDX-License-Identifier: Apache-2.0"""
import contextlib
import copy
import multiprocessing
import os
import pickle
import subprocess
import sys

import pytest
from conftest import GOLDEN

import roofgs
from roofgs._errors import _KINDS, make
from roofgs._library import Handle, call


def load_missing(path):
    return roofgs.load(path)


def test_a_missing_file_is_one(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        roofgs.load(tmp_path / "none.rgs")
    error = caught.value
    assert isinstance(error, (roofgs.Error, OSError)) and error.code == "open_failed" and error.errno == 2
    assert error.file == str(tmp_path / "none.rgs") and str(error).startswith(error.file + ": ")


def test_numbers_of_damaged_files(tmp_path):
    whole = (GOLDEN / "degree3.rgs").read_bytes()
    (tmp_path / "short.rgs").write_bytes(whole[:-100])
    with pytest.raises(roofgs.FormatError) as caught:
        roofgs.load(tmp_path / "short.rgs")
    error = caught.value
    assert error.code == "truncated" and error.expected == len(whole) and error.found == len(whole) - 100
    assert isinstance(error, ValueError) and error.hint


def test_cancelled_work_ends_by_an_error(tmp_path, scene):
    work = Handle()
    call("make_work", into=work)
    call("cancel", work=work)
    with pytest.raises(roofgs.Error) as caught:
        call("save", path=os.fsencode(tmp_path / "a.rgs"), work=work, scene=scene._native, profile="packed", lod="", overwrite=False,
             sync=False, strict=False, spz_axes="ply")
    assert caught.value.code == "cancelled" and not list(tmp_path.iterdir())


# What is there of levels whose end is missing is no error.
WITHOUT_END = ("levels_page_missing", "levels_positions_missing")
REJECTED = sorted(path for path in (GOLDEN / "reject").glob("*.rgs") if path.stem not in WITHOUT_END)


@pytest.mark.parametrize("entry", REJECTED[::9], ids=lambda path: path.stem)
def test_rejected_files(entry):
    with pytest.raises(roofgs.Error) as caught:
        roofgs.info(entry, verify=True)
    assert caught.value.code in str(caught.value) and caught.value.file == str(entry)


@pytest.mark.parametrize("code", [*_KINDS, "checksum_mismatch"])
def test_exceptions_survive_pickling_and_copies(code):
    error = make(code, "what", "why", "a.rgs", 12, 34, 56, 2)
    for again in (pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
        assert type(again) is type(error) and str(again) == str(error)
        assert (again.code, again.file, again.offset, again.expected, again.found, again.errno, again.hint) == \
            (code, "a.rgs", 12, 34, 56, 2, "why")


def test_exceptions_reach_other_processes(tmp_path):
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        with pytest.raises(roofgs.MissingFileError) as caught:
            pool.apply(load_missing, (str(tmp_path / "none.rgs"),))
    assert caught.value.code == "open_failed" and caught.value.file == str(tmp_path / "none.rgs")


def test_options_of_programs_become_arguments():
    assert str(make("output_exists", "pass --overwrite to replace it")) == \
        "pass overwrite=True to replace it [output_exists]"
    text = str(make("bad_value", "--on-bad drop leaves such out, without --strict; give --memory, or --profile packed"))
    assert text == ("on_bad='drop' leaves such out, without strict=True; give memory=, or profile='packed' [bad_value]")


@pytest.mark.parametrize("said, meant", [
    ("pass --memory=8GiB", "pass memory=8GiB"), ("--on-bad=drop, or --on-bad dropped", "on_bad='drop', or on_bad= dropped"),
    ("--lod=best takes longer than --lod", "lod=best takes longer than lod=True"),
    ("state --from, not --from=ply", "state from_=, not from_=ply"), ("choose --profile archive:high", "choose profile='archive:high'")])
def test_options_with_values(said, meant):
    assert make("bad_argument", said).message == meant


@pytest.mark.parametrize("file, shown", [
    ("https://me:secret@host.org/a.rgs?token=12#x", "https://host.org/a.rgs"), ("HTTP://me@host:8/", "HTTP://host:8/"),
    ("http://host/a@b.rgs", "http://host/a@b.rgs"), ("me@host?x.rgs", "me@host?x.rgs"), (None, None)])
def test_addresses_are_shown_without_what_is_secret(file, shown):
    error = make("open_failed", "is away", file=file)
    assert error.file == shown and "secret" not in str(error) and "12" not in str(error)
    assert pickle.loads(pickle.dumps(error)).file == shown


@pytest.mark.parametrize("use", [roofgs.load, roofgs.StreamedScene])
def test_addresses_that_fail_are_shown_so(use):
    with pytest.raises(roofgs.Error) as caught:
        use("http://me:secret@127.0.0.1:1/a.rgs?token=12")
    assert caught.value.file == "http://127.0.0.1:1/a.rgs" and "secret" not in str(caught.value)


@pytest.mark.parametrize("use", [roofgs.info, lambda a: scene_of_one().save(a), roofgs.cameras.load,
                                 lambda a: roofgs.cameras.save(a, []), lambda a: roofgs.convert(a, "a.ply"),
                                 lambda a: roofgs.convert("a.ply", a), lambda a: roofgs.audit("a.ply", a)])
def test_what_reads_and_writes_files_alone_refuses_addresses(use):
    with pytest.raises(roofgs.ArgumentError, match="roofgs.load") as caught:
        use("https://me:secret@host.org/a.rgs")
    assert caught.value.file == "https://host.org/a.rgs"


def scene_of_one():
    return roofgs.Scene([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[1, 1, 1]])


FORKED = """
import multiprocessing, sys
import roofgs

def child(path, queue):
    try:
        queue.put(len(roofgs.load(path)))
    except roofgs.Error as error:
        queue.put((error.code, "spawn" in str(error)))

if sys.argv[2] == "used":
    scene = roofgs.load(sys.argv[1])
    stream = roofgs.StreamedScene(sys.argv[3])
    roofgs.Renderer(device="cpu").render(scene, roofgs.cameras.default_view(scene, width=64, height=64))
context = multiprocessing.get_context("fork")
queue = context.Queue()
process = context.Process(target=child, args=(sys.argv[1], queue))
process.start()
print(queue.get())
process.join()
print(process.exitcode)
"""


@pytest.mark.parametrize("use, said", [("used", "('unavailable', True)"), ("unused", "40")])
def test_forks(use, said, examples):
    out = subprocess.run([sys.executable, "-c", FORKED, GOLDEN / "degree3.rgs", use, examples / "levels.rgs"],
                         capture_output=True, text=True, check=True, env=os.environ)
    assert out.stdout.splitlines() == [said, "0"]


ASKED = """
import multiprocessing, sys
import roofgs

def child(queue):
    for ask in (lambda: renderer.stats, lambda: stream.stats, lambda: stream.check(), lambda: pool.host_bytes, lambda: scene.means):
        try:
            queue.put(repr(ask()))
        except roofgs.Error as error:
            queue.put(error.code)

scene, pool, renderer = roofgs.load(sys.argv[1]), roofgs.StreamPool(), roofgs.Renderer(device="cpu")
stream = roofgs.StreamedScene(sys.argv[2], pool=pool)
renderer.render(scene, roofgs.cameras.default_view(scene, width=64, height=64))
context = multiprocessing.get_context("fork")
queue = context.Queue()
process = context.Process(target=child, args=(queue,))
process.start()
print(*[queue.get() for _ in range(5)])
process.join()
print(process.exitcode)
"""


def test_what_waits_for_a_lock_is_refused_after_a_fork(examples):
    # A thread of the parent may have held it.
    out = subprocess.run([sys.executable, "-c", ASKED, GOLDEN / "degree3.rgs", examples / "levels.rgs"], capture_output=True,
                         text=True, check=True, env=os.environ)
    assert out.stdout.splitlines() == [" ".join(["unavailable"] * 5), "0"]


DAEMONS = """
import sys, threading, numpy as np, roofgs
scene = roofgs.load(sys.argv[1])
renderer = roofgs.Renderer(device="cpu")
view = roofgs.cameras.default_view(scene, width=320, height=240)

def saves(n=[0]):
    n[0] += 1
    scene.save(f"{sys.argv[2]}/{n[0]}.rgs")

def values():
    return roofgs.Scene(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0).means

def forever(work, begun):
    while True:
        work()
        begun.set()

works = [lambda: renderer.render(scene, view), lambda: roofgs.load(sys.argv[1]).sh, saves, values]
events = [threading.Event() for _ in works]
for work, begun in zip(works, events):
    threading.Thread(target=forever, args=(work, begun), daemon=True).start()
for begun in events:
    begun.wait()
"""


def test_a_process_ends_while_daemon_threads_are_at_work(examples, tmp_path):
    for i in range(3):
        folder = tmp_path / str(i)
        folder.mkdir()
        out = subprocess.run([sys.executable, "-c", DAEMONS, examples / "scene.rgs", folder], capture_output=True, text=True,
                             env=os.environ)
        assert (out.returncode, out.stderr) == (0, "")


CLASSES = [each for each in vars(roofgs).values() if isinstance(each, type) and not issubclass(each, (BaseException, tuple, dict))]


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_an_object_without_init_has_nothing_to_give(cls):
    made = cls.__new__(cls)
    uses = [name for name, member in vars(cls).items() if name not in ("__init__", "__doc__") and
            (callable(member) or isinstance(member, property))]
    assert uses
    for name in uses:
        with contextlib.suppress(AttributeError, TypeError):  # not the end of the interpreter
            getattr(made, name)()


@pytest.mark.parametrize("call", [roofgs.load, roofgs.info, roofgs.StreamedScene, roofgs.Renderer, roofgs.Camera,
                                  roofgs.cameras.look_at, roofgs.Scene.save, roofgs.Renderer.render],
                         ids=lambda call: call.__qualname__)
def test_an_unknown_argument_is_a_type_error(call):
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'profil'"):
        call(profil="direct")


def test_numbers_that_json_does_not_have_are_named():
    with pytest.raises(roofgs.ArgumentError, match="low_pass is nan"):
        roofgs.Scene([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[1, 1, 1]], low_pass=float("nan"))
