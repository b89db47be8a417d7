"""What the tests of the module share. SPDX-License-Identifier: Apache-2.0"""
import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

import roofgs

PROGRAMS = Path(os.environ["ROOFGS_PROGRAMS"])
ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden"

# A process that a shell starts in the background ignores Ctrl-C, and Python then installs no handler.
if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def program(name, *arguments):
    subprocess.run([PROGRAMS / name, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


@pytest.fixture(scope="session")
def examples(tmp_path_factory):
    """A folder with a scene of 2,000 Gaussians as a PLY, an .rgs and an .rgs with levels, and eight cameras of 320x240."""
    folder = tmp_path_factory.mktemp("examples")
    program("rgs-make-scene", "--seed", 7, "--gaussians", 2000, "--degree", 3, "--cameras", folder / "all.json",
            folder / "scene.ply", "--quiet")
    cameras = roofgs.cameras.load(folder / "all.json")[:8]
    roofgs.cameras.save(folder / "cameras.json", [camera.resized(320, 240) for camera in cameras])
    program("rgs-convert", folder / "scene.ply", folder / "scene.rgs", "--quiet")
    program("rgs-convert", "--lod", folder / "scene.ply", folder / "levels.rgs", "--quiet")
    return folder


@pytest.fixture(scope="session")
def scene(examples):
    return roofgs.load(examples / "scene.rgs")


@pytest.fixture(scope="session")
def renderer():
    return roofgs.Renderer(device="cpu")


@pytest.fixture(scope="session")
def has_gpu():
    """Whether this build and this machine render with CUDA."""
    try:
        return roofgs.Renderer(device="cuda").device == "cuda"
    except roofgs.UnavailableError:
        return False


@pytest.fixture()
def camera(scene):
    return roofgs.cameras.default_view(scene, width=64, height=48)


@pytest.fixture(autouse=True)
def examples_of_docstrings(doctest_namespace, examples, tmp_path):
    doctest_namespace.update(roofgs=roofgs, examples=examples, folder=tmp_path, np=np)


def pytest_runtest_logreport(report):
    """A case that could not run is a line that scripts/test_python.sh shows."""
    if report.skipped:
        print(f"\nskipped: {report.nodeid}: {report.longrepr[2] if isinstance(report.longrepr, tuple) else ''}", flush=True)
