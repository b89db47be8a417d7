"""Pictures. SPDX-License-Identifier: Apache-2.0"""
import os
import signal
import struct
import threading
import types
import zlib

import numpy as np
import pytest
from conftest import GOLDEN, program
from test_cameras import turned

import roofgs
from roofgs import cameras


def read_png(path):
    """An 8-bit RGB picture, by the PNG specification's filters."""
    data, at, header, packed = path.read_bytes(), 8, None, b""
    while at < len(data):
        size, kind = struct.unpack(">I4s", data[at:at + 8])
        body = data[at + 8:at + 8 + size]
        header = body if kind == b"IHDR" else header
        packed += body if kind == b"IDAT" else b""
        at += 12 + size
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    assert (bits, colour, interlaced) == (8, 2, 0)
    raw, stride = np.frombuffer(zlib.decompress(packed), np.uint8).astype(int).reshape(height, 1 + 3 * width), 3 * width
    above, image = np.zeros(stride, int), np.zeros((height, stride), int)
    for y in range(height):
        row, kind = raw[y, 1:].copy(), raw[y, 0]
        for x in range(stride):
            a, b, c = row[x - 3] if x >= 3 else 0, above[x], above[x - 3] if x >= 3 else 0
            p = a + b - c
            near = a if abs(p - a) <= abs(p - b) and abs(p - a) <= abs(p - c) else b if abs(p - b) <= abs(p - c) else c
            row[x] = (row[x] + (0, a, b, (a + b) // 2, near)[kind]) % 256
        image[y] = above = row
    return image.reshape(height, width, 3).astype(np.uint8)


def one_gaussian(mean, scale=0.02, opacity=0.9, colour=(1.0, 0.5, 0.25), **others):
    return roofgs.Scene([mean], [[1, 0, 0, 0]], [[scale] * 3], [opacity],
                        ((np.array(colour) - 0.5) / 0.28209479177387814).reshape(1, 1, 3), **others)


@pytest.mark.parametrize("name", ["scene.rgs", "levels.rgs"])
def test_pictures_are_those_of_rgs_render(name, examples, renderer, tmp_path):
    program("rgs-render", examples / name, "--cameras", examples / "cameras.json", "--view", 3, "--out",
            tmp_path / "a.png", "--backend", "cpu", "--quiet")
    scene = roofgs.load(examples / name)
    camera = cameras.load(examples / "cameras.json")[3]
    expected = read_png(tmp_path / "a.png")
    assert np.array_equal(renderer.render(scene, camera, dtype="uint8"), expected)
    assert expected.std() > 5


def test_8_bit_codes_are_rounded(renderer):
    scene = one_gaussian((0, 0, 2.0), scale=0.1)
    camera = roofgs.Camera(64, 48, 60)
    exact = renderer.render(scene, camera, background=(2.0, -1.0, 0.5))
    codes = renderer.render(scene, camera, background=(2.0, -1.0, 0.5), dtype=np.uint8)
    expected = np.floor(np.clip(exact, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)
    assert np.array_equal(codes, expected) and len(np.unique(codes)) > 20
    assert codes.max() == 255 and codes.min() == 0


def test_pictures_do_not_depend_on_threads_or_runs(scene, camera, renderer):
    first = renderer.render(scene, camera)
    for threads in (1, 2):
        other = roofgs.Renderer(device="cpu", threads=threads)
        assert np.array_equal(other.render(scene, camera), first)
        assert np.array_equal(other.render(scene, camera), first)


def test_a_gaussian_is_where_the_camera_convention_puts_it(renderer):
    camera = roofgs.Camera(70, 50, 60.5, 80.25, 30.0, 20.0, turned())
    mean = np.array([0.25, -0.35, 0.1])
    at = turned() @ [*mean, 1]
    u, v = camera.fx * at[0] / at[2] + camera.cx, camera.fy * at[1] / at[2] + camera.cy
    frame = renderer.render(one_gaussian(mean), camera, alpha=True, depth=True)
    weight = frame.alpha / frame.alpha.sum()
    y, x = np.mgrid[0:50, 0:70] + 0.5
    assert abs((weight * x).sum() - u) < 0.02 and abs((weight * y).sum() - v) < 0.02
    row, column = int(v), int(u)
    assert frame.depth[row, column] == pytest.approx(at[2], rel=1e-5)
    np.testing.assert_allclose(frame.image[row, column], frame.alpha[row, column] * np.array([1, 0.5, 0.25]), rtol=1e-5)
    assert frame.depth[0, 0] == 0 == frame.alpha[0, 0]


def test_background_planes_and_degrees(renderer):
    camera = roofgs.Camera(20, 20, 30)
    near = one_gaussian((0, 0, 2.0))
    assert np.array_equal(renderer.render(near, camera, near_plane=3.0, background=(0.1, 0.2, 0.3))[5, 5],
                          np.array([0.1, 0.2, 0.3], np.float32))
    assert renderer.render(near, camera).max() > 0.4
    assert renderer.render(near, camera, far_plane=1.5).max() == 0 == renderer.render(near, camera, near_plane=2.5).max()
    scene = roofgs.load(GOLDEN / "degree3.rgs")
    view = cameras.default_view(scene, width=32, height=24)
    assert not np.array_equal(renderer.render(scene, view), renderer.render(scene, view, sh_degree=0))


@pytest.mark.parametrize("options", [dict(background=(np.nan, 0, 0)), dict(near_plane=np.nan), dict(far_plane=np.nan),
                                     dict(near_plane=-1.0), dict(low_pass=np.nan), dict(low_pass=-1.0),
                                     dict(anti_aliasing="no"), dict(sh_degree=4), dict(detail=np.nan),
                                     dict(detail=-1.0), dict(max_gaussians=-1), dict(dtype="float64")])
def test_options_that_nothing_can_mean(options, scene, camera, renderer):
    with pytest.raises(roofgs.ArgumentError):
        renderer.render(scene, camera, **options)


def test_backgrounds_of_all_kinds(scene, camera, renderer):
    expected = renderer.render(scene, camera, background=(0.5, 0.25, 1.0))
    for other in ([0.5, 0.25, 1.0], np.array([0.5, 0.25, 1.0]), np.float32([0.5, 0.25, 1])):
        assert np.array_equal(renderer.render(scene, camera, background=other), expected)


@pytest.mark.parametrize("wrong", [(1, 1), np.zeros((1, 3)), np.zeros((3, 1)), 0.5, None, "red", {0.5}])
def test_what_is_no_background(wrong, scene, camera, renderer):
    with pytest.raises(roofgs.ArgumentError, match="^background "):
        renderer.render(scene, camera, background=wrong)


def test_backgrounds_that_are_tensors_are_not_kept(scene, camera):
    renderer = roofgs.Renderer(device="cpu")
    tensor = Bfloat16([0.5, 0.25, 1.0])
    first = renderer.render(scene, camera, background=tensor)
    assert np.array_equal(first, renderer.render(scene, camera, background=(0.5, 0.25, 1.0)))
    assert len(renderer._options) == 1


def test_degrees_are_whole_numbers(scene, camera):
    renderer = roofgs.Renderer(device="cpu")
    for _ in range(2):  # also behind a picture that had the same value
        with pytest.raises(TypeError, match="integer"):
            renderer.render(scene, camera, sh_degree=2.0)
        renderer.render(scene, camera, sh_degree=np.int64(2))


@pytest.mark.parametrize("method, arguments", [("render", (roofgs.Camera(8, 8, 10),)), ("prepare", ()),
                                               ("refine", (roofgs.Camera(8, 8, 10),))])
def test_files_are_not_taken_for_what_they_hold(method, arguments, scene, renderer):
    with pytest.raises(TypeError, match="roofgs.load"):
        getattr(renderer, method)("scene.rgs", *arguments)
    if method == "render":
        with pytest.raises(TypeError, match="roofgs.cameras.load"):
            renderer.render(scene, "cameras.json")


def test_bad_renderers():
    for wrong in (dict(device="gpu"), dict(pipeline="fast"), dict(threads=-1), dict(threads=2**40),
                  dict(devices=[0, -1]), dict(devices=[2**40]), dict(device="cpu", devices=[0])):
        with pytest.raises(roofgs.ArgumentError):
            roofgs.Renderer(**wrong)
    with pytest.raises(roofgs.UnavailableError) as caught:
        if os.path.exists("/dev/nvidia0"):
            pytest.skip("there is a GPU")
        roofgs.Renderer(device="cuda")
    assert caught.value.code == "unavailable"


# ---- outputs


def test_outputs_are_filled_in_place(scene, camera, renderer):
    expected = renderer.render(scene, camera, alpha=True, depth=True)
    image, alpha, depth = np.full((48, 64, 3), 7, np.float32), np.empty((48, 64), np.float32), np.empty((48, 64), np.float32)
    frame = renderer.render(scene, camera, out=(image, alpha, depth), alpha=True, depth=True)
    assert frame.image is image and frame.alpha is alpha and frame.depth is depth
    for have, want in zip(frame, expected):
        assert np.array_equal(have, want)
    codes = np.empty((48, 64, 3), np.uint8)
    assert renderer.render(scene, camera, out=codes) is codes
    assert np.array_equal(codes, renderer.render(scene, camera, dtype="uint8"))


class Bfloat16:
    """What of a torch.Tensor on the CPU counts here, of a type that NumPy does not have."""

    __module__, dtype, requires_grad = "torch", "torch.bfloat16", False
    device = types.SimpleNamespace(type="cpu")

    def __init__(self, values):
        self.values = values

    def detach(self):
        return self

    cpu = detach

    def __iter__(self):
        return map(Bfloat16, self.values)

    def __len__(self):
        return len(self.values)

    def __float__(self):
        return self.values

    def float(self):
        return types.SimpleNamespace(numpy=lambda: np.float32(self.values))

    def numpy(self):
        raise TypeError("Got unsupported ScalarType BFloat16")


def wrong_outputs():
    frozen = np.empty((48, 64, 3), np.float32)
    frozen.flags.writeable = False
    return {"double": np.empty((48, 64, 3)), "turned": np.empty((64, 48, 3), np.float32),
            "strided": np.empty((48, 128, 3), np.float32)[:, ::2], "reversed": np.empty((48, 64, 3), np.float32)[::-1],
            "fortran": np.asfortranarray(np.empty((48, 64, 3), np.float32)), "swapped": np.empty((48, 64, 3), ">f4"),
            "batched": np.empty((1, 48, 64, 3), np.float32), "rgba": np.empty((48, 64, 4), np.float32),
            "frozen": frozen, "signed": np.empty((48, 64, 3), np.int8), "bfloat16": Bfloat16([]),
            "list": [[0.0]]}


@pytest.mark.parametrize("name", wrong_outputs())
def test_outputs_that_do_not_fit_are_refused(name, scene, camera, renderer):
    with pytest.raises(roofgs.ArgumentError):
        renderer.render(scene, camera, out=wrong_outputs()[name])


def test_outputs_that_are_not_asked_for_stay_as_they_are(scene, camera, renderer):
    for alpha, depth in ((True, False), (False, True)):
        out = roofgs.Frame(np.zeros((48, 64, 3), np.float32), *(np.full((48, 64), np.nan, np.float32) for _ in range(2)))
        frame = renderer.render(scene, camera, out=out, alpha=alpha, depth=depth)
        assert frame.image is out.image
        assert frame.alpha is (out.alpha if alpha else None) and frame.depth is (out.depth if depth else None)
        assert np.isnan(out.alpha).all() == (not alpha) and np.isnan(out.depth).all() == (not depth)


def test_outputs_do_not_share_memory(scene, camera, renderer):
    memory = np.zeros(48 * 64 * 4, np.float32)
    image, alpha = memory[:48 * 64 * 3].reshape(48, 64, 3), memory[48 * 64 * 3:].reshape(48, 64)
    renderer.render(scene, camera, out=(image, alpha, None), alpha=True)
    overlapping = memory[48 * 64 * 2:48 * 64 * 3].reshape(48, 64)
    before = memory.copy()
    with pytest.raises(roofgs.ArgumentError, match="share"):
        renderer.render(scene, camera, out=(image, overlapping, None), alpha=True)
    assert np.array_equal(memory, before)


def test_torch_tensors_are_scenes_and_outputs(scene, camera, renderer):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    made = roofgs.Scene(*(torch.from_numpy(getattr(scene, name).copy())
                          for name in ("means", "quats", "scales", "opacities", "sh0", "shN")))
    out = torch.zeros((48, 64, 3))
    image = renderer.render(made, camera, out=out)
    assert image is out and np.array_equal(out.numpy(), renderer.render(made, camera))
    np.testing.assert_allclose(image.numpy(), renderer.render(scene, camera), atol=1e-5)
    alpha = torch.empty((48, 64))
    frame = renderer.render(made, camera, out=(out, alpha, None), alpha=True, depth=True)
    assert frame.image is out and frame.alpha is alpha and isinstance(frame.depth, np.ndarray)
    with torch.no_grad():
        image = renderer.render(made, camera, out=torch.zeros((48, 64, 3), requires_grad=True))
    assert torch.equal(image, out)
    with pytest.raises(roofgs.ArgumentError):
        renderer.render(made, camera, out=torch.zeros((64, 48, 3)).permute(1, 0, 2))
    with pytest.raises(NotImplementedError, match="gradient"):
        renderer.render(made, camera, out=torch.zeros((48, 64, 3), requires_grad=True))


def test_out_and_dtype_must_agree(scene, camera, renderer):
    with pytest.raises(roofgs.ArgumentError):
        renderer.render(scene, camera, out=np.empty((48, 64, 3), np.uint8), dtype="float32")
    with pytest.raises(roofgs.ArgumentError):
        renderer.render(scene, camera, out=np.empty((48, 64, 3), np.float32), alpha=True)


# ---- several cameras


def test_batches_are_single_pictures_one_after_the_other(scene, examples, renderer):
    views = cameras.load(examples / "cameras.json")
    frame = renderer.render(scene, views, alpha=True, depth=True)
    assert frame.image.shape == (8, 240, 320, 3) and frame.alpha.shape == frame.depth.shape == (8, 240, 320)
    for i, view in enumerate(views):
        single = renderer.render(scene, view, alpha=True, depth=True)
        for have, want in zip(frame, single):
            assert np.array_equal(have[i], want)
    assert not np.array_equal(frame.image[0], frame.image[1])
    codes = renderer.render(scene, iter(views), dtype="uint8")
    assert np.array_equal(codes[5], renderer.render(scene, views[5], dtype="uint8"))
    assert len(renderer.stats) == 1 and renderer.stats[0]["visible"] > 0


def test_batches_of_none_one_and_unequal(scene, camera, renderer):
    assert renderer.render(scene, [camera]).shape == (1, 48, 64, 3) and len(renderer.stats) == 1
    assert renderer.render(scene, []).shape == (0, 0, 0, 3) and renderer.stats == []
    with pytest.raises(roofgs.ArgumentError, match="one size"):
        renderer.render(scene, [camera, camera.resized(32, 24)])
    with pytest.raises((TypeError, roofgs.ArgumentError)):
        renderer.render(scene, [camera, None])
    with pytest.raises(TypeError):
        renderer.render(scene, 3)


def test_batches_keep_their_cameras(scene, renderer):
    def made():
        for i in range(20):
            yield roofgs.Camera(16, 12, 10.0 + i)

    assert renderer.render(scene, made()).shape == (20, 12, 16, 3)


# ---- levels of detail


def test_detail(examples, renderer):
    levels, whole = roofgs.load(examples / "levels.rgs"), roofgs.load(examples / "scene.rgs")
    far = cameras.look_at((0, -100, -600), (0, 0, 0), width=64, height=48)
    drawn = []
    for detail in (0, 0.5, 4, 64):
        renderer.render(levels, far, detail=detail)
        drawn.append(renderer.stats[0]["gaussians"])
    assert drawn[0] == 2000 and drawn == sorted(drawn, reverse=True) and drawn[-1] < 1000
    renderer.render(levels, far, detail=0, max_gaussians=drawn[1])
    assert renderer.stats[0]["gaussians"] <= drawn[1] and 0 < renderer.stats[0]["detail_px"] <= 0.6
    renderer.render(levels, far, detail=0.5, max_gaussians=drawn[1])
    assert renderer.stats[0]["gaussians"] == drawn[1] and renderer.stats[0]["detail_px"] == 0.5
    # Order in the file breaks no ties here, so that both files give one picture.
    np.testing.assert_allclose(renderer.render(levels, far, detail=0), renderer.render(whole, far), atol=1e-5)


# ---- threads and signals


def test_threads_share_a_renderer(scene, renderer):
    views = cameras.orbit(scene, 6, width=64, height=48)
    expected = [renderer.render(scene, view) for view in views]
    found = [None] * 6

    def draw(i):
        for _ in range(5):
            found[i] = renderer.render(scene, views[i])

    threads = [threading.Thread(target=draw, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(a, b) for a, b in zip(found, expected))


def interrupted(call):
    """Sends Ctrl-C, from a thread that runs while `call` is under way; True if it ended by it."""
    begun = threading.Event()

    def send():
        begun.wait()
        os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        call(begun)
    except KeyboardInterrupt:
        return True
    finally:
        begun.set()
        sender.join()
    return False


def test_ctrl_c_ends_a_batch(scene, renderer):
    view = cameras.default_view(scene, width=320, height=240)

    def draw(begun):
        begun.set()
        renderer.render(scene, [view.resized(32, 24)] * len(out), out=out, background=(1, 1, 1))

    out = np.zeros((100_000, 24, 32, 3), np.uint8)
    assert interrupted(draw)
    assert not out[-1].any()  # the last picture would be white
    assert renderer.render(scene, view).shape == (240, 320, 3)  # it goes on as before
