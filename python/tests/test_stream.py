"""Streamed scenes, from disks and web servers. SPDX-License-Identifier: Apache-2.0"""
import functools
import gc
import http.server
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from conftest import GOLDEN, program
from web_server import Ranges

import roofgs
from roofgs import _library, cameras

WITHOUT_LIMIT = 1e6  # seconds


@pytest.fixture(scope="module")
def server(examples):
    handler = functools.partial(Ranges, directory=str(examples))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


@pytest.mark.parametrize("where", ["disk", "web"])
def test_a_refined_view_is_the_whole_file(where, examples, server, renderer):
    whole = roofgs.load(examples / "levels.rgs")
    view = cameras.default_view(whole, width=96, height=72)
    name = examples / "levels.rgs" if where == "disk" else f"{server}/levels.rgs"
    with roofgs.StreamedScene(name) as scene:
        assert len(scene) == 2000 and scene.sh_degree == 3
        early = renderer.render(scene, view)  # whatever is there
        assert early.shape == (72, 96, 3)
        assert renderer.refine(scene, view, WITHOUT_LIMIT)
        for dtype in ("float32", "uint8"):
            assert np.array_equal(renderer.render(scene, view, dtype=dtype), renderer.render(whole, view, dtype=dtype))
        stats = scene.stats
        assert stats["pages_missing"] == 0 < stats["pages_resident"] and stats["bytes_read"] > 0
        scene.check()
        assert scene.up == whole.up
        # Of so few pages the table tells where the whole scene is, not where its subject is.
        (low, high), (subject_low, subject_high) = np.array(scene.bounds), np.array(whole.bounds)
        assert (low <= subject_low).all() and (high >= subject_high - 0.01 * np.ptp(whole.bounds, axis=0)).all()
    assert scene.closed


def test_a_budget_that_holds_nothing(examples):
    with pytest.raises(roofgs.Error) as caught:
        roofgs.StreamedScene(examples / "levels.rgs", host_memory=1000)
    assert caught.value.code in ("host_out_of_memory", "limit_exceeded") and caught.value.expected > 1000
    for wrong in (0, -1, 1 << 64):
        with pytest.raises(roofgs.ArgumentError):
            roofgs.StreamedScene(examples / "levels.rgs", host_memory=wrong)


def opens(path, host_memory):
    try:
        roofgs.StreamedScene(path, host_memory=host_memory).close()
    except roofgs.Error:
        return False
    return True


def test_scenes_share_a_pool(examples, renderer):
    pool = roofgs.StreamPool(host_memory=64 << 20)
    assert (pool.host_memory, pool.device_memory, pool.host_bytes, pool.device_bytes) == (64 << 20, 0, 0, 0)
    whole = roofgs.load(examples / "levels.rgs")
    view = cameras.default_view(whole, width=32, height=24)
    with roofgs.StreamedScene(examples / "levels.rgs", pool=pool) as one:
        assert renderer.refine(one, view, WITHOUT_LIMIT)
        held = pool.host_bytes
        assert 0 < held <= pool.host_memory and one.pool is pool
        with roofgs.StreamedScene(GOLDEN / "levels_packed.rgs", pool=pool) as other:
            assert pool.host_bytes > held  # both are counted
            renderer.refine(other, cameras.default_view(other, width=32, height=24), WITHOUT_LIMIT)
        assert np.array_equal(renderer.render(one, view), renderer.render(whole, view))
    assert pool.host_bytes == 0
    # A pool that one scene has filled has no room for another.
    budget = 1000
    while not opens(examples / "levels.rgs", budget):
        budget += budget // 4
    small = roofgs.StreamPool(host_memory=budget)
    with roofgs.StreamedScene(examples / "levels.rgs", pool=small):
        with pytest.raises(roofgs.Error) as caught:
            roofgs.StreamedScene(examples / "levels.rgs", pool=small)
        assert caught.value.code in ("host_out_of_memory", "limit_exceeded")
    assert repr(small) == f"roofgs.StreamPool(host_memory={small.host_memory})"


def test_pools_that_cannot_be(examples):
    for wrong in (0, -1, 1 << 64):
        with pytest.raises(roofgs.ArgumentError):
            roofgs.StreamPool(host_memory=wrong)
    with pytest.raises(roofgs.ArgumentError):
        roofgs.StreamPool(device_memory=-1)
    for budget in ({"host_memory": 1 << 30}, {"device_memory": 1 << 30}):
        with pytest.raises(roofgs.ArgumentError, match=f"{next(iter(budget))} are those of the pool"):
            roofgs.StreamedScene(examples / "levels.rgs", pool=roofgs.StreamPool(), **budget)


def test_memory_of_a_device(examples, renderer, has_gpu):
    if not has_gpu:
        for make in (lambda: roofgs.StreamedScene(examples / "levels.rgs", device_memory=1 << 26),
                     lambda: roofgs.StreamedScene(examples / "levels.rgs", pool=roofgs.StreamPool(device_memory=1 << 26))):
            with pytest.raises(roofgs.UnavailableError) as caught:
                make()
            assert caught.value.code == "unavailable" and "::" not in str(caught.value)
        pytest.skip("there is no GPU")
    on_gpu, whole = roofgs.Renderer(device="cuda"), roofgs.load(examples / "levels.rgs")
    view = cameras.default_view(whole, width=96, height=72)
    pool = roofgs.StreamPool(device_memory=1 << 28)
    with roofgs.StreamedScene(examples / "levels.rgs", pool=pool) as scene:
        assert 0 < pool.device_bytes <= 1 << 27  # the other half is the workspace's
        assert on_gpu.refine(scene, view, WITHOUT_LIMIT)
        assert np.array_equal(on_gpu.render(scene, view), on_gpu.render(whole, view))
        assert scene.stats["bytes_uploaded"] > 0 and pool.device_bytes <= pool.device_memory
        with pytest.raises(roofgs.UnavailableError, match="device_memory"):
            renderer.render(scene, view)  # by the CPU
    assert pool.device_bytes == 0
    with roofgs.StreamedScene(examples / "levels.rgs") as scene, pytest.raises(roofgs.UnavailableError, match="device_memory"):
        on_gpu.render(scene, view)


def test_a_file_without_levels_is_no_stream(examples):
    with pytest.raises(roofgs.FormatError) as caught:
        roofgs.StreamedScene(examples / "scene.rgs")
    assert caught.value.code == "missing_section"


def test_closed_scenes(examples, renderer):
    scene = roofgs.StreamedScene(examples / "levels.rgs")
    view, begun = cameras.default_view(scene, width=8, height=8), scene._native
    scene.close()
    scene.close()
    for use in (lambda: renderer.render(scene, view), lambda: renderer.refine(scene, view), lambda: scene.stats,
                lambda: len(scene), lambda: _library.call("facts", scene=begun)):
        with pytest.raises(roofgs.ArgumentError, match="closed"):
            use()
    assert "closed" in repr(scene) and "closed" in scene._repr_html_()
    for _ in range(3):  # one that nobody closes ends with its last reference
        roofgs.StreamedScene(examples / "levels.rgs")
        gc.collect()


def test_a_scene_ends_though_an_exception_is_kept(examples, renderer):
    pool = roofgs.StreamPool(host_memory=64 << 20)
    with pytest.raises(roofgs.ArgumentError) as kept, roofgs.StreamedScene(examples / "levels.rgs", pool=pool) as scene:
        view = cameras.default_view(scene, width=8, height=8)
        assert pool.host_bytes > 0
        renderer.render(scene, view, near_plane=2, far_plane=1)
    assert pool.host_bytes == 0
    assert kept.value


@pytest.mark.parametrize("heard_after", [b"start", b"wait", b"reply_of"])
def test_ctrl_c_loses_no_value(heard_after, examples, monkeypatch):
    pool, real = roofgs.StreamPool(host_memory=64 << 20), _library._call

    def interrupted(name, arguments):
        reply = real(name, arguments)
        if name == heard_after:
            monkeypatch.setattr(_library, "_call", real)
            raise KeyboardInterrupt
        return reply

    monkeypatch.setattr(_library, "_call", interrupted)
    with pytest.raises(KeyboardInterrupt):
        roofgs.StreamedScene(examples / "levels.rgs", pool=pool)
    for work in list(_library._left):  # what goes on ends, and the next long call frees it
        assert _library.call("wait", work=work, seconds=WITHOUT_LIMIT)
        del work
    roofgs.info(examples / "levels.rgs")
    gc.collect()
    assert (pool.host_bytes, _library._left) == (0, {})


def test_frames_with_alpha_and_depth(examples, renderer):
    whole = roofgs.load(examples / "levels.rgs")
    views = cameras.orbit(whole, 3, width=32, height=24)
    with roofgs.StreamedScene(examples / "levels.rgs") as scene:
        for view in views:
            assert renderer.refine(scene, view, WITHOUT_LIMIT)
        for have, want in zip(renderer.render(scene, views, alpha=True, depth=True),
                              renderer.render(whole, views, alpha=True, depth=True)):
            assert np.array_equal(have, want)


def test_seconds_are_numbers(examples, renderer):
    with roofgs.StreamedScene(examples / "levels.rgs") as scene:
        view = cameras.default_view(scene, width=8, height=8)
        for wrong in (-1, float("nan")):
            with pytest.raises(roofgs.ArgumentError):
                renderer.refine(scene, view, wrong)


def test_addresses_are_loaded_as_a_whole(examples, server):
    for name in ("scene.rgs", "scene.ply", "levels.rgs"):
        calls = []
        scene = roofgs.load(f"{server}/{name}", progress=lambda *facts: calls.append(facts))
        other = roofgs.load(examples / name)
        assert np.array_equal(scene.means, other.means) and scene.format == other.format
        size = (examples / name).stat().st_size
        assert calls[-1] == ("read", size, size, "B")
    with pytest.raises(FileNotFoundError) as caught:
        roofgs.load(f"{server}/none.rgs")
    assert isinstance(caught.value, roofgs.MissingFileError)
    assert caught.value.found == 404 and caught.value.file.endswith("/none.rgs")


def test_html(examples):
    with roofgs.StreamedScene(GOLDEN / "levels_packed.rgs") as scene:
        assert "<img" in scene._repr_html_()


class Slow(Ranges):
    """The same, but that it gives the first bytes alone, and of /silent nothing, until it is told to go on."""

    waits, go_on = threading.Event(), threading.Event()

    def do_GET(self):
        asked = self.headers.get("Range", "bytes=0-")
        if self.path == "/silent" or int(asked.removeprefix("bytes=").partition("-")[0]) > 0:
            self.waits.set()
            self.go_on.wait()
        super().do_GET()


INTERRUPTED = """
import os, signal, sys
import roofgs

signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    if sys.argv[2] == "load":
        roofgs.load(sys.argv[1])
    else:
        scene = roofgs.StreamedScene(sys.argv[1])
        view = roofgs.cameras.default_view(scene, width=640, height=480)
        roofgs.Renderer(device="cpu").refine(scene, view, 1e6, detail=0)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    child = os.fork()  # without the thread that was left behind
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def big_folder(tmp_path_factory):
    # More than the 64 KiB that a source keeps of its first answer.
    big = tmp_path_factory.mktemp("big")
    program("rgs-make-scene", "--gaussians", "20k", big / "scene.ply", "-q")
    roofgs.load(big / "scene.ply").save(big / "levels.rgs", lod=True)
    return big


@pytest.fixture(scope="module")
def slow_server(big_folder):
    handler = functools.partial(Slow, directory=str(big_folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}"
        Slow.go_on.set()
        server.shutdown()
        serving.join()


@pytest.mark.parametrize("name", ["levels.rgs", "silent"])
@pytest.mark.parametrize("how", ["stream", "load"])
def test_ctrl_c_ends_a_wait(name, how, slow_server):
    Slow.waits.clear()
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED, f"{slow_server}/{name}", how], stdout=subprocess.PIPE,
                          text=True) as process:
        try:
            Slow.waits.wait()
            process.send_signal(signal.SIGINT)
            out = process.stdout.read()  # nothing else ends the wait
            process.wait()
        finally:
            process.kill()
    assert (out.split(), process.returncode) == (["interrupted", "0"], 0)


WAITS_FOR_EVER = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static int open_or_wait(const char* function, const char* path, int flags, mode_t mode) {
  if (strstr(path, "waits-for-ever")) {
    write(STDOUT_FILENO, "waits\n", 6);
    for (;;) pause();
  }
  return ((int (*)(const char*, int, ...))dlsym(RTLD_NEXT, function))(path, flags, mode);
}
int open(const char* path, int flags, mode_t mode) { return open_or_wait("open", path, flags, mode); }
int open64(const char* path, int flags, mode_t mode) { return open_or_wait("open64", path, flags, mode); }
"""


def test_another_ctrl_c_ends_the_process_without_work_that_never_ends(tmp_path):
    (tmp_path / "open.c").write_text(WAITS_FOR_EVER)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", tmp_path / "open.so", tmp_path / "open.c", "-ldl"], check=True)
    process = subprocess.Popen([sys.executable, "-c", INTERRUPTED, "waits-for-ever.rgs", "load"], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, env={**os.environ, "LD_PRELOAD": str(tmp_path / "open.so")})
    try:
        assert process.stdout.readline() == "waits\n"
        process.send_signal(signal.SIGINT)
        assert [process.stdout.readline() for _ in range(2)] == ["interrupted\n", "0\n"]
        while process.poll() is None:  # the first may come before the wait for threads begins
            process.send_signal(signal.SIGINT)
            try:
                process.wait(0.1)
            except subprocess.TimeoutExpired:
                pass
        said = process.stderr.read()
    finally:
        process.kill()
        process.communicate()
    assert process.returncode in (0, 130, -signal.SIGINT) and "KeyboardInterrupt" in said


# Once it is armed, whoever waits for a thread says so and goes on when Python has answered.
JOINS = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <unistd.h>

int pthread_join(pthread_t thread, void** value) {
  if (access("armed", F_OK) == 0) {
    close(open("joining", O_CREAT | O_WRONLY, 0600));
    while (access("answered", F_OK) != 0) usleep(1000);
  }
  return ((int (*)(pthread_t, void**))dlsym(RTLD_NEXT, "pthread_join"))(thread, value);
}
"""

CLOSED_MEANWHILE = """
import contextlib, functools, http.server, sys, threading
from pathlib import Path

sys.path.insert(0, sys.argv[1])
from test_stream import Slow
import roofgs

with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Slow, directory=sys.argv[2])) as server:
    threading.Thread(target=server.serve_forever, daemon=True).start()
    Slow.go_on.set()
    scene = roofgs.StreamedScene(f"http://127.0.0.1:{server.server_port}/levels.rgs", prefetch=False)
    Slow.go_on.clear()
    view = roofgs.cameras.default_view(scene, width=640, height=480)
    renderer = roofgs.Renderer(device="cpu", threads=1)

    def wait():
        with contextlib.suppress(roofgs.ArgumentError):  # closed
            renderer.refine(scene, view, 1e6, detail=0)

    def answer():
        while not Path("joining").exists():
            pass
        Path("answered").touch()

    waits, answers = threading.Thread(target=wait), threading.Thread(target=answer)
    waits.start()
    while scene.stats["pages_missing"] == 0:
        pass
    Path("armed").touch()
    answers.start()
    scene.close()  # one of the two threads has the last copy
    print("closed", flush=True)
    Slow.go_on.set()
    waits.join()
    answers.join()
    server.shutdown()
print("ended")
"""


def test_python_runs_while_a_scene_ends_that_was_closed_during_a_wait(tmp_path, big_folder):
    (tmp_path / "join.c").write_text(JOINS)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", tmp_path / "join.so", tmp_path / "join.c", "-ldl"], check=True)
    preload = " ".join([*os.environ.get("LD_PRELOAD", "").split(), str(tmp_path / "join.so")])  # sanitizers come first
    out = subprocess.run([sys.executable, "-c", CLOSED_MEANWHILE, os.path.dirname(__file__), big_folder], cwd=tmp_path,
                         capture_output=True, text=True, env={**os.environ, "LD_PRELOAD": preload})
    assert (out.stdout.split(), out.stderr) == (["closed", "ended"], "")
