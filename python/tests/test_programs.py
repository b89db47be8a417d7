"""convert(), prune(), audit(). SPDX-License-Identifier: Apache-2.0"""
import inspect
import os
import pickle
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from conftest import GOLDEN, PROGRAMS, program

import roofgs
from roofgs import _programs


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_a_conversion_is_that_of_the_program(examples, tmp_path):
    done = roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", profile="archive:high", sh_degree=2)
    program("rgs-convert", examples / "scene.ply", tmp_path / "b.rgs", "--profile", "archive:high", "--sh-degree", 2,
            "--quiet")
    assert (tmp_path / "a.rgs").read_bytes() == (tmp_path / "b.rgs").read_bytes()
    assert done["schema"].startswith("rgs-convert/") and done["profile"] == "archive"


def test_options_of_all_kinds(examples, tmp_path):
    low, high = roofgs.load(examples / "scene.rgs").bounds
    done = roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", crop=(*low, 0.0, *high[1:]), lod=False, axes=None,
                          translate=(-1, 0.5, np.float32(2)), keep_order=True, from_="ply")
    assert 0 < done["output"]["gaussians"] < 2000
    moved = roofgs.convert([examples / "scene.ply", examples / "scene.rgs"], tmp_path / "b.ply",
                           translate=[(0, 0, 0), np.array([1000.0, 0, 0])])
    assert moved["output"]["gaussians"] == 4000
    means = roofgs.load(tmp_path / "b.ply").means
    np.testing.assert_allclose(means[2000:].mean(axis=0) - means[:2000].mean(axis=0), [1000, 0, 0], atol=0.01)


@pytest.mark.parametrize("name, program_alone", [
    ("convert", {"audit", "jobs", "keep_going", "list", "lod_assemble", "lod_build", "lod_input", "lod_list", "lod_partition",
                 "no_keep_going", "overwrite_damaged", "ranges", "report", "shard", "formats"}),
    ("prune", set()), ("audit", {"junit"})])
def test_the_options_are_those_of_the_program(name, program_alone):
    said = subprocess.run([PROGRAMS / f"rgs-{name}", "--help"], check=True, capture_output=True, text=True).stdout
    options = {option.replace("-", "_") for option in re.findall(r"^  (?:-\w,)?(?:--aa,)?--([a-z-]+)", said, re.MULTILINE)}
    here = {parameter.rstrip("_") for parameter in inspect.signature(getattr(roofgs, name)).parameters}
    assert here - {"src", "dst", "asset", "progress"} == options - program_alone - {"help", "version", "json", "quiet"}


@pytest.mark.parametrize("wrong", [dict(profile="best"), dict(sh_degree=9), dict(min_opacity=float("nan")), dict(near="soon")])
def test_wrong_options(wrong, examples, tmp_path):
    with pytest.raises(roofgs.ArgumentError) as caught:
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", **wrong)
    assert caught.value.code == "bad_argument" and names(tmp_path) == []


def test_errors_are_those_of_the_library(examples, tmp_path):
    whole = (GOLDEN / "degree3.rgs").read_bytes()
    (tmp_path / "short.rgs").write_bytes(whole[:-100])
    with pytest.raises(roofgs.FormatError) as caught:
        roofgs.convert(tmp_path / "short.rgs", tmp_path / "a.ply")
    error = caught.value
    assert (error.code, error.file, error.expected, error.found) == \
        ("truncated", str(tmp_path / "short.rgs"), len(whole), len(whole) - 100)
    with pytest.raises(FileNotFoundError) as caught:
        roofgs.convert(tmp_path / "none.ply", tmp_path / "a.rgs")
    assert caught.value.errno == 2
    (tmp_path / "a.rgs").write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="overwrite=True") as caught:
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs")
    assert "--" not in str(caught.value) and (tmp_path / "a.rgs").read_bytes() == b"mine"
    roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", overwrite=True)
    with pytest.raises(roofgs.ArgumentError, match="folder"):
        roofgs.convert(tmp_path, tmp_path / "out")


def test_strange_names(examples, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = (examples / "scene.ply").read_bytes()
    for name in ("-", "--json", "a b'\"$(x).ply"):
        (tmp_path / name).write_bytes(data)
        roofgs.convert(name, "out.rgs", overwrite=True)
        assert len(roofgs.load("out.rgs")) == 2000
    roofgs.convert(b"--json", b"caf\xe9.rgs")
    roofgs.convert("-", "-out.rgs")
    assert sorted(os.listdir(b".")) == sorted([b"-", b"--json", b"a b'\"$(x).ply", b"out.rgs", b"caf\xe9.rgs", b"-out.rgs"])
    with pytest.raises(ValueError, match="null"):
        roofgs.convert("a\0.ply", "b.rgs")


def test_progress(examples, tmp_path):
    calls = []
    roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", progress=lambda *facts: calls.append(facts))
    assert {"scan", "encode"} <= {stage for stage, *_ in calls}
    assert [(done, total) for stage, done, total, _ in calls if stage == "encode"][-1] == (2000, 2000)
    with pytest.raises(TypeError):
        roofgs.convert(examples / "scene.ply", tmp_path / "b.rgs", progress=3)


def test_an_error_in_the_callback_ends_the_program(examples, tmp_path):
    def fail(*_):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", lod=True, progress=fail)
    assert names(tmp_path) in ([], ["a.rgs"])  # whole or not at all


STUCK = """#!{python}
import os, signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
with open("{folder}/pid", "w") as file:
    print(os.getpid(), file=file)
print('{{"progress": {{"stage": "encode", "done": 1, "total": 2, "unit": ""}}}}', file=sys.stderr, flush=True)
signal.sigwait([signal.SIGTERM])
with open("{folder}/end", "w") as file:
    print("ended", file=file)
sys.exit(1)
"""


@pytest.fixture()
def stuck(tmp_path_factory, monkeypatch):
    """An rgs-convert that tells of its progress and then waits for SIGTERM."""
    folder = tmp_path_factory.mktemp("programs")
    script = folder / "rgs-convert"
    script.write_text(STUCK.format(python=sys.executable, folder=folder))
    script.chmod(0o755)
    monkeypatch.setenv("ROOFGS_PROGRAMS", str(folder))
    return folder


def test_ctrl_c_ends_the_program(stuck, examples, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", progress=lambda *_: os.kill(os.getpid(), signal.SIGINT))
    assert (stuck / "end").read_text() == "ended\n"
    with pytest.raises(ProcessLookupError):  # it has ended, and has been waited for
        os.kill(int((stuck / "pid").read_text()), 0)


@pytest.mark.parametrize("stage", ["scan", "levels", "commit"])
def test_ctrl_c_leaves_no_unfinished_file(stage, examples, tmp_path, monkeypatch):
    monkeypatch.setenv("RGS_FAILPOINT", f"{stage}:0:{int(signal.SIGSTOP)}")
    interrupted = []

    def interrupt(begun, *_):
        if begun == stage:  # it has stopped there, or is about to
            interrupted.append(stage)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs", lod=True, progress=interrupt)
    assert interrupted == [stage] and names(tmp_path) == []


def test_a_program_that_is_killed(stuck, examples, tmp_path):
    with pytest.raises(roofgs.InternalError, match="signal 9"):
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs",
                       progress=lambda *_: os.kill(int((stuck / "pid").read_text()), signal.SIGKILL))


def test_a_program_that_is_not_there(monkeypatch, tmp_path, examples):
    monkeypatch.setenv("ROOFGS_PROGRAMS", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(roofgs.UnavailableError, match="rgs-convert"):
        roofgs.convert(examples / "scene.ply", tmp_path / "a.rgs")


# ---- prune


def test_cameras_in_memory_keep_their_split(examples, tmp_path):
    views = roofgs.cameras.load(examples / "cameras.json")
    is_test = [i % 2 == 0 for i in range(len(views))]
    declared = roofgs.cameras.CameraList(views, is_test, "list", True)
    done = roofgs.prune(examples / "scene.rgs", tmp_path / "a.ply", declared, keep=0.5, split="train")
    roofgs.prune(examples / "scene.rgs", tmp_path / "b.ply", [view for view, test in zip(views, is_test) if not test], keep=0.5)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert done["output"]["gaussians"] == 1000


def test_pruning_is_that_of_the_program(examples, tmp_path):
    done = roofgs.prune(examples / "scene.rgs", tmp_path / "a.ply", examples / "cameras.json", keep=0.25, score="max",
                        size=(64, 48))
    program("rgs-prune", examples / "scene.rgs", tmp_path / "b.ply", "--cameras", examples / "cameras.json", "--keep",
            "25%", "--score", "max", "--size", "64x48", "--quiet")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert done["output"]["gaussians"] == 500 and done["score"] == "max"


@pytest.mark.parametrize("keep, kept", [(300, 300), ("10%", 200), (1.0, 2000), (1, 1), (0.1, 200),
                                        (np.float32(0.5), 1000), (np.int64(300), 300)])
def test_how_many_are_kept(keep, kept, examples, tmp_path):
    views = roofgs.cameras.load(examples / "cameras.json")[:2]
    done = roofgs.prune(examples / "scene.rgs", tmp_path / "a.rgs", views, keep=keep)
    assert done["output"]["gaussians"] == kept and done["cameras"] == 2
    assert not list(tmp_path.glob("roofgs-*"))


def test_pruning_needs_to_know_how_many(examples, tmp_path):
    for wrong in (dict(), dict(keep=1.5), dict(keep=-0.1), dict(keep=0.5, min_contribution=1.0)):
        with pytest.raises(roofgs.ArgumentError):
            roofgs.prune(examples / "scene.rgs", tmp_path / "a.rgs", examples / "cameras.json", **wrong)


# ---- audit


def test_audits(examples, tmp_path):
    views = roofgs.cameras.load(examples / "cameras.json")
    found = roofgs.audit(examples / "scene.ply", examples / "scene.rgs", cameras=views, size=(64, 48),
                         report=tmp_path / "page.html", fail_below={"psnr": 30, "worst_psnr": 20})
    assert found["schema"] == "rgs-audit/3" and found.holds and found["rendered"]["psnr"] > 30
    assert found.measured["psnr"] == found["rendered"]["psnr"] and found.grade in ("identical", "no_visible_loss", "close")
    assert found.verdict in repr(found) and "psnr" in found._repr_html_()
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")
    assert isinstance(pickle.loads(pickle.dumps(found)), roofgs.Audit)


def test_a_condition_that_does_not_hold(examples):
    with pytest.raises(roofgs.QualityError, match="psnr") as caught:
        roofgs.audit(examples / "scene.ply", examples / "scene.rgs", cameras=examples / "cameras.json", size="64x48",
                     fail_below="psnr=200", no_attribution=True)
    error = pickle.loads(pickle.dumps(caught.value))
    assert error.code == "gate_failed" and not error.report.holds and error.report["rendered"]["psnr"] < 200
    assert error.file == str(examples / "scene.rgs")


def test_audits_that_cannot_be(examples, tmp_path):
    with pytest.raises(roofgs.ArgumentError, match="quality"):
        roofgs.audit(examples / "scene.ply", examples / "scene.rgs", fail_below={"quality": 1})
    with pytest.raises(FileNotFoundError):
        roofgs.audit(examples / "scene.ply", tmp_path / "none.rgs", no_render=True)


def test_programs_are_found_in_the_package_before_the_path(monkeypatch, tmp_path):
    monkeypatch.delenv("ROOFGS_PROGRAMS")
    monkeypatch.setenv("PATH", str(tmp_path))
    mine = tmp_path / "rgs-info"
    mine.write_text("#!/bin/sh\n")
    mine.chmod(0o755)
    assert _programs.find_program("rgs-info") == str(mine)
