#!/usr/bin/python3
"""Whether pictures get to a GPU's memory as they should, and how fast many small ones are drawn: on a machine with an NVIDIA GPU and torch.

    python3 gpu_check.py [scene.rgs] [--views 10000] [--batch 100]

One line a check; the last line is JSON with what was measured. Exit code 1 if a check fails. It needs no program and no other file than
measure_views.py and web_server.py; test_gpu.py runs its checks under pytest. SPDX-License-Identifier: Apache-2.0
"""
import argparse
import functools
import gc
import http.server
import json
import sys
import tempfile
import threading
import traceback
from pathlib import Path

import numpy as np
from measure_views import overhead, seconds, throughput
from web_server import Ranges

import roofgs
from roofgs import cameras

CHECKS = []


def check(function):
    CHECKS.append(function)
    return function


def made_scene(n, seed=5):
    random = np.random.default_rng(seed)
    return roofgs.Scene(means=random.normal(size=(n, 3)), quats=random.normal(size=(n, 4)),
                        scales=np.exp(random.uniform(-4.5, -2.5, (n, 3))), opacities=random.uniform(0.1, 1, n),
                        sh0=random.normal(size=(n, 1, 3)), shN=0.1 * random.normal(size=(n, 15, 3)))


class Stage:
    """What checks share."""

    def __init__(self):
        import torch

        self.torch = torch
        self.scene = made_scene(3000)
        self.views = cameras.orbit(self.scene, 70, width=80, height=48)  # more than are drawn together
        self.renderer = roofgs.Renderer(device="cuda")
        self.expected = [self.renderer.render(self.scene, view, alpha=True, depth=True) for view in self.views]

    def empty(self, *shape, dtype=None):
        tensor = self.torch.empty(shape, dtype=dtype or self.torch.float32, device="cuda")
        return tensor.fill_(77)

    def codes(self, i):
        return self.renderer.render(self.scene, self.views[i], dtype="uint8")


def same(tensor, array):
    assert np.array_equal(tensor.cpu().numpy(), array), "the pictures differ"


def refused(kind, call, text=""):
    try:
        call()
    except kind as error:
        assert text in str(error) and "::" not in str(error), error
    else:
        raise AssertionError(f"not refused with {kind.__name__}")


@check
def a_picture_in_a_tensor_is_the_one_in_the_hosts_memory(s):
    for i in (0, 1):
        out = s.empty(48, 80, 3)
        assert s.renderer.render(s.scene, s.views[i], out=out) is out
        # Depth and alpha are blended otherwise than colour alone: the picture alone is compared with a picture alone.
        same(out, s.renderer.render(s.scene, s.views[i]))
    assert s.renderer.stats[0]["total_ms"] > 0


@check
def codes_in_a_tensor_are_those_in_the_hosts_memory(s):
    out = s.empty(48, 80, 3, dtype=s.torch.uint8)
    assert s.renderer.render(s.scene, s.views[3], out=out) is out
    same(out, s.codes(3))


@check
def a_frame_with_alpha_and_depth(s):
    out = (s.empty(48, 80, 3), s.empty(48, 80), s.empty(48, 80))
    frame = s.renderer.render(s.scene, s.views[0], out=out, alpha=True, depth=True)
    assert all(have is want for have, want in zip(frame, out))
    for have, want in zip(frame, s.expected[0]):
        same(have, want)
    some = s.renderer.render(s.scene, s.views[0], out=(out[0], None, None), depth=True)
    assert some.alpha is None and isinstance(some.depth, roofgs.DeviceArray)
    same(s.torch.from_dlpack(some.depth), s.expected[0].depth)


@check
def several_pictures_are_those_of_each(s):
    n = len(s.views)
    out = (s.empty(n, 48, 80, 3), s.empty(n, 48, 80), s.empty(n, 48, 80))
    s.renderer.render(s.scene, s.views, out=out, alpha=True, depth=True)
    on_host = s.renderer.render(s.scene, s.views, alpha=True, depth=True)
    assert len(s.renderer.stats) == n
    for i, wanted in enumerate(s.expected):
        for have, host, want in zip(out, on_host, wanted):
            same(have[i], want)
            assert np.array_equal(host[i], want)
    codes = s.empty(n, 48, 80, 3, dtype=s.torch.uint8)
    s.renderer.render(s.scene, s.views, out=codes)
    host_codes = s.renderer.render(s.scene, s.views, dtype="uint8")
    for i in range(n):
        same(codes[i], s.codes(i))
        assert np.array_equal(host_codes[i], s.codes(i))


@check
def several_devices_draw_the_same(s):
    several = roofgs.Renderer(devices=[0, 0, 0])
    expected = s.renderer.render(s.scene, s.views, alpha=True, depth=True)
    for have, want in zip(several.render(s.scene, s.views, alpha=True, depth=True), expected):
        assert np.array_equal(have, want)
    assert len(several.stats) == len(s.views)
    refused(roofgs.ArgumentError, lambda: several.render(s.scene, s.views, on_device=True), "several devices")


@check
def new_arrays_on_the_device(s):
    for dtype in ("float32", "uint8"):
        wanted = s.renderer.render(s.scene, s.views[2], dtype=dtype)
        array = s.renderer.render(s.scene, s.views[2], dtype=dtype, on_device=True)
        assert array.shape == (48, 80, 3) and array.dtype == dtype and array.nbytes == wanted.nbytes
        assert array.__dlpack_device__()[0] == 2 and "cuda:" in repr(array)
        tensor = s.torch.from_dlpack(array)
        also = s.torch.as_tensor(array, device="cuda")
        del array
        gc.collect()
        same(tensor, wanted)  # it holds the memory
        same(also, wanted)
    capsule = s.renderer.render(s.scene, s.views[2], on_device=True).__dlpack__()
    del capsule  # nobody has taken it
    refused(BufferError, lambda: s.renderer.render(s.scene, s.views[2], on_device=True).__dlpack__(copy=True))
    assert s.renderer.render(s.scene, [], on_device=True).shape == (0, 0, 0, 3)


@check
def memory_comes_back(s):
    def free():
        gc.collect()
        s.torch.cuda.synchronize()
        return s.torch.cuda.mem_get_info()[0]

    view = s.views[0].resized(4096, 4096)
    s.torch.from_dlpack(s.renderer.render(s.scene, view, on_device=True))
    before = free()
    for _ in range(3):
        s.torch.from_dlpack(s.renderer.render(s.scene, view, on_device=True))  # 201 MB
    assert before - free() < 100 << 20, "arrays were not freed"


@check
def the_current_stream_comes_first(s):
    stream = s.torch.cuda.Stream()
    wanted = s.renderer.render(s.scene, s.views[4])
    out = s.empty(48, 80, 3)
    s.torch.cuda.synchronize()
    with s.torch.cuda.stream(stream):
        s.torch.cuda._sleep(200_000_000)  # a tenth of a second and more
        out.fill_(-1)
        s.renderer.render(s.scene, s.views[4], out=out)
        doubled = 2 * out
    stream.synchronize()
    same(out, wanted)
    same(doubled, 2 * wanted)


@check
def other_arrays_that_describe_themselves(s):
    class Described:
        def __init__(self, tensor, **other):
            self.tensor, self.__cuda_array_interface__ = tensor, {**tensor.__cuda_array_interface__, **other}

    out = Described(s.empty(48, 80, 3), stream=1)
    assert s.renderer.render(s.scene, s.views[5], out=out) is out
    same(out.tensor, s.renderer.render(s.scene, s.views[5]))
    refused(roofgs.ArgumentError, lambda: s.renderer.render(
        s.scene, s.views[5], out=Described(out.tensor, data=(out.tensor.data_ptr(), True))), "read-only")
    try:
        import cupy
    except ImportError:
        return
    array = cupy.empty((48, 80, 3), cupy.uint8)
    s.renderer.render(s.scene, s.views[5], out=array)
    assert np.array_equal(array.get(), s.codes(5))
    assert np.array_equal(cupy.from_dlpack(s.renderer.render(s.scene, s.views[5], dtype="uint8", on_device=True)).get(), s.codes(5))


@check
def wrong_outputs_are_refused(s):
    def draw(out, **options):
        return lambda: s.renderer.render(s.scene, s.views[0], out=out, **options)

    refused(roofgs.ArgumentError, draw(s.empty(48, 80, 3, dtype=s.torch.float16)), "data type")
    refused(roofgs.ArgumentError, draw(s.empty(48, 81, 3)), "shape")
    refused(roofgs.ArgumentError, draw(s.empty(48, 3, 80).transpose(1, 2)), "contiguous")
    refused(NotImplementedError, draw(s.empty(48, 80, 3).requires_grad_()), "gradient")
    refused(roofgs.ArgumentError, draw((s.empty(48, 80, 3), np.empty((48, 80), np.float32), None), alpha=True), "all of them")
    refused(roofgs.ArgumentError, draw(np.empty((48, 80, 3), np.float32), on_device=True), "all of them")
    both = s.empty(48 * 80 * 3)
    refused(roofgs.ArgumentError, draw((both.view(48, 80, 3), both[:48 * 80].view(48, 80), None), alpha=True), "share memory")
    cpu = roofgs.Renderer(device="cpu")
    refused(roofgs.UnavailableError, lambda: cpu.render(s.scene, s.views[0], out=s.empty(48, 80, 3)), "device='cuda'")
    same(s.renderer.render(s.scene, s.views[0], out=s.empty(48, 80, 3)), s.renderer.render(s.scene, s.views[0]))


@check
def scenes_and_rasterization_of_tensors(s):
    t = {name: s.torch.tensor(getattr(s.scene, name), device="cuda") for name in ("means", "quats", "scales", "opacities", "sh")}
    again = roofgs.Scene(t["means"], t["quats"], t["scales"], t["opacities"], t["sh"][:, :1], t["sh"][:, 1:])
    assert np.array_equal(again.means, s.scene.means) and np.array_equal(again.shN, s.scene.shN)
    view = s.views[0]
    matrix = s.torch.tensor(view.world_to_camera, dtype=s.torch.float32, device="cuda")[None]
    k = s.torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], dtype=s.torch.float32, device="cuda")[None]
    colors, alphas, _ = roofgs.rasterization(t["means"], t["quats"], t["scales"], t["opacities"], t["sh"], matrix, k, 80, 48,
                                             sh_degree=3)
    assert colors.is_cuda and alphas.is_cuda and colors.shape == (1, 48, 80, 3)
    assert abs(colors[0].cpu().numpy() - s.expected[0].image).max() < 0.05


@check
def it_looks_like_the_cpus_picture(s):
    wanted = roofgs.Renderer(device="cpu").render(s.scene, s.views[0])
    error = np.mean((s.renderer.render(s.scene, s.views[0]) - wanted) ** 2)
    assert -10 * np.log10(max(error, 1e-12)) > 40, f"mean squared error {error}"


@check
def threads_with_streams_of_their_own(s):
    problems = []

    def draw(i):
        try:
            renderer, stream = roofgs.Renderer(device="cuda"), s.torch.cuda.Stream()
            out = s.empty(48, 80, 3)
            s.torch.cuda.synchronize()
            with s.torch.cuda.stream(stream):
                for _ in range(20):
                    renderer.render(s.scene, s.views[i], out=out)
                    same(out, s.renderer.render(s.scene, s.views[i]))
        except BaseException as error:  # of a thread, said by the one that waits
            problems.append(error)

    threads = [threading.Thread(target=draw, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems, problems


@check
def streamed_scenes_in_the_devices_memory(s):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "levels.rgs"
        s.scene.save(path, lod=True)
        whole = roofgs.load(path)
        pool = roofgs.StreamPool(device_memory=1 << 28)
        with roofgs.StreamedScene(path, pool=pool) as scene:
            assert pool.device_bytes > 0
            assert s.renderer.refine(scene, s.views[0], 60)
            assert np.array_equal(s.renderer.render(scene, s.views[0]), s.renderer.render(whole, s.views[0]))
            refused(roofgs.ArgumentError, lambda: s.renderer.render(scene, s.views[0], on_device=True), "streamed")
        assert pool.device_bytes == 0


@check
def streamed_scenes_from_a_web_server(s):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "levels.rgs"
        s.scene.save(path, lod=True)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Ranges, directory=folder)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            with roofgs.StreamedScene(f"http://127.0.0.1:{server.server_port}/levels.rgs", device_memory=1 << 28) as scene:
                assert s.renderer.refine(scene, s.views[0], 60)
                assert np.array_equal(s.renderer.render(scene, s.views[0]), s.renderer.render(roofgs.load(path), s.views[0]))
            server.shutdown()


def measured(path, n_views, batch, size=256):
    import torch

    scene = roofgs.load(path) if path else made_scene(200_000)
    renderer = roofgs.Renderer(device="cuda")
    views = cameras.orbit(scene, n_views, width=size, height=size)
    renderer.render(scene, views[:batch])
    one, several = throughput(renderer, scene, views, size, batch)
    on_device_one, on_device_several = throughput(
        renderer, scene, views, size, batch, lambda shape: torch.empty(shape, dtype=torch.uint8, device="cuda"))
    all_out, device_out = np.empty((len(views), size, size, 3), np.uint8), None
    whole = seconds(lambda: renderer.render(scene, views, out=all_out))
    frames = [frame["total_ms"] for frame in renderer.stats]
    del all_out, device_out
    return {"device": renderer.name, "gaussians": len(scene), "size": size, "views": n_views, "batch": batch,
            "one_by_one_per_second": round(one), "in_batches_per_second": round(several), "ratio": round(several / one, 2),
            "on_device_one_by_one_per_second": round(on_device_one), "on_device_in_batches_per_second": round(on_device_several),
            "on_device_ratio": round(on_device_several / on_device_one, 2),
            "on_device_batches_to_one_by_one_on_host": round(on_device_several / one, 2),
            "all_views_in_one_call_per_second": round(len(views) / whole), "median_frame_ms": round(float(np.median(frames)), 4),
            "overhead_us": round(overhead(roofgs.Renderer(device="cpu", threads=1)), 1)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--views", type=int, default=10_000)
    parser.add_argument("--batch", type=int, default=100)
    a = parser.parse_args()
    stage, n_failed = Stage(), 0
    print(f"{roofgs.__version__} on {stage.renderer.name}, Python {sys.version.split()[0]}, NumPy {np.__version__}, "
          f"torch {stage.torch.__version__}", flush=True)
    for each in CHECKS:
        name = each.__name__.replace("_", " ")
        try:
            each(stage)
            print(f"pass  {name}", flush=True)
        except Exception:
            n_failed += 1
            print(f"FAIL  {name}\n{traceback.format_exc()}", flush=True)
    print(json.dumps({"failed": n_failed, **measured(a.scene, a.views, a.batch)}))
    return 1 if n_failed else 0


if __name__ == "__main__":
    sys.exit(main())
