"""Pictures in a GPU's memory: what is refused without one, and gpu_check.py with one. SPDX-License-Identifier: Apache-2.0"""
import gpu_check
import numpy as np
import pytest

import roofgs


@pytest.fixture(scope="module")
def stage(has_gpu):
    if not has_gpu:
        pytest.skip("there is no GPU")
    pytest.importorskip("torch")
    return gpu_check.Stage()


@pytest.mark.parametrize("check", gpu_check.CHECKS, ids=lambda check: check.__name__)
def test_on_a_gpu(check, stage):
    check(stage)


class Described:
    """What says of itself that it is on a GPU."""

    def __init__(self, shape, **other):
        self.__cuda_array_interface__ = {"shape": shape, "typestr": "<f4", "data": (1 << 20, False), "version": 3, **other}


def test_the_cpu_draws_nothing_on_a_device(scene, camera, renderer):
    for options in ({"on_device": True}, {"out": Described((48, 64, 3))}, {"out": Described((48, 64, 3), typestr="|u1")},
                    {"out": Described((48, 64, 3), strides=(768, 12, 4))},
                    {"out": (Described((48, 64, 3)), None, None), "alpha": True}):
        with pytest.raises(roofgs.UnavailableError) as caught:
            renderer.render(scene, camera, **options)
        assert "device='cuda'" in str(caught.value) and "::" not in str(caught.value)


@pytest.mark.parametrize("out, text", [
    (Described((48, 64)), "shape"), (Described((48, 65, 3)), "shape"), (Described((48, 64, 3), typestr="<f2"), "data type"),
    (Described((48, 64, 3), typestr=">f4"), "data type"), (Described((48, 64, 3), strides=(1536, 24, 4)), "C-contiguous"),
    (Described((48, 64, 3), data=(1 << 20, True)), "read-only")])
def test_wrong_arrays_on_a_device_are_refused(scene, camera, renderer, out, text):
    with pytest.raises(roofgs.ArgumentError, match=text):
        renderer.render(scene, camera, out=out)


def test_outputs_are_in_one_memory(examples, scene, camera, renderer):
    on_device, on_host = Described((48, 64, 3)), np.empty((48, 64), np.float32)
    with pytest.raises(roofgs.ArgumentError, match="all of them"):
        renderer.render(scene, camera, out=(on_device, on_host, None), alpha=True)
    with pytest.raises(roofgs.ArgumentError, match="all of them"):
        renderer.render(scene, camera, out=np.empty((48, 64, 3), np.float32), on_device=True)
    share = Described((48, 64), data=((1 << 20) + 48 * 64 * 3 * 4 - 4, False))
    with pytest.raises(roofgs.ArgumentError, match="share memory"):
        renderer.render(scene, camera, out=(on_device, share, None), alpha=True)
    with roofgs.StreamedScene(examples / "levels.rgs") as streamed, pytest.raises(roofgs.ArgumentError, match="streamed"):
        renderer.render(streamed, camera, on_device=True)
