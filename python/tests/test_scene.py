"""Scenes: arrays, lifetimes, saving. SPDX-License-Identifier: Apache-2.0"""
import copy
import gc
import os
import pickle
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import GOLDEN

import roofgs


def attributes(n=3, seed=1, coefficients=16):
    r = np.random.default_rng(seed)
    quats = r.normal(size=(n, 4))
    return dict(means=r.normal(size=(n, 3)), quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
                scales=r.uniform(0.01, 0.3, (n, 3)), opacities=r.uniform(0.05, 0.95, n), sh0=r.normal(size=(n, 1, 3)),
                shN=r.normal(size=(n, coefficients - 1, 3)) if coefficients > 1 else None)


def test_arrays_are_views_in_the_documented_shapes():
    scene = roofgs.load(GOLDEN / "degree2.rgs")
    n = len(scene)
    shapes = dict(means=(n, 3), quats=(n, 4), scales=(n, 3), opacities=(n,), sh=(n, 9, 3), sh0=(n, 1, 3), shN=(n, 8, 3))
    for name, shape in shapes.items():
        array = getattr(scene, name)
        assert array.shape == shape and array.dtype == np.float32, name
        assert not array.flags.writeable, name
        assert np.shares_memory(array, getattr(scene, name)), name
    assert np.array_equal(scene.sh[:, :1], scene.sh0) and np.array_equal(scene.sh[:, 1:], scene.shN)
    with pytest.raises(ValueError):
        scene.means[0] = 0
    with pytest.raises(ValueError):
        scene.means.flags.writeable = True


def test_views_outlive_their_scene():
    scene = roofgs.load(GOLDEN / "degree3.rgs")
    means, higher = scene.means, scene.shN[5:]
    expected, expected_higher = means.copy(), higher.copy()
    del scene
    gc.collect()
    rubbish = [np.full(100_000, 7, np.float32) for _ in range(20)]
    assert np.array_equal(means, expected) and np.array_equal(higher, expected_higher)
    assert len(rubbish) == 20


def test_values_are_activated():
    # The golden scene in numbers: opacities are no logits, scales no logarithms, rotations unit quaternions.
    scene = roofgs.load(GOLDEN / "degree3.rgs")
    assert 0 < scene.opacities.min() and scene.opacities.max() < 1
    assert scene.scales.min() > 0
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=1), 1, atol=2e-3)


def test_a_scene_of_arrays_has_their_values():
    given = attributes(coefficients=9)
    scene = roofgs.Scene(**given)
    for name, values in given.items():
        assert np.array_equal(getattr(scene, name), values.astype(np.float32)), name
    assert scene.sh_degree == 2 and len(scene) == 3 and scene.path is None and scene.format is None


def test_arrays_are_copied():
    given = {name: value.astype(np.float32) for name, value in attributes().items()}
    scene = roofgs.Scene(**given)
    before = scene.means.copy()
    given["means"][:] = 7
    assert np.array_equal(scene.means, before)


def test_strided_big_endian_and_other_arrays_are_read_by_value():
    given = attributes(n=4)
    expected = roofgs.Scene(**given)
    strided = {name: np.repeat(value, 2, axis=0)[::2] for name, value in given.items()}
    strided["means"] = np.asfortranarray(given["means"])
    swapped = {name: value.astype(">f4") for name, value in given.items()}
    doubled = {name: value.astype(">f8") for name, value in given.items()}
    lists = {name: value.tolist() for name, value in given.items()}
    for other in (strided, swapped, doubled, lists):
        scene = roofgs.Scene(**other)
        for name in given:
            assert np.array_equal(getattr(scene, name), getattr(expected, name)), name


def test_dlpack_arrays():
    class Exported:  # an array of a library that NumPy does not know
        def __init__(self, array):
            self.array = array

        def __dlpack__(self, **keywords):
            return self.array.__dlpack__(**keywords)

        def __dlpack_device__(self):
            return self.array.__dlpack_device__()

    given = {name: value.astype(np.float32) for name, value in attributes().items()}
    scene = roofgs.Scene(**{name: Exported(value) for name, value in given.items()})
    assert np.array_equal(scene.means, given["means"]) and np.array_equal(scene.shN, given["shN"])


def test_rotations_are_normalised_and_zero_is_none():
    given = attributes(n=2)
    given["quats"] = [[3, 0, 4, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(roofgs.Scene(**given).quats, [[0.6, 0, 0.8, 0], [1, 0, 0, 0]], rtol=1e-6)


@pytest.mark.parametrize("name, value", [("means", np.nan), ("means", np.inf), ("quats", np.nan), ("scales", -0.1),
                                         ("scales", np.inf), ("opacities", 1.5), ("opacities", np.nan),
                                         ("sh0", np.nan), ("shN", np.inf), ("means", 1e39)])
def test_damaged_values_are_refused_by_name_and_index(name, value):
    given = attributes(n=5)
    given[name][3] = value
    with pytest.raises(roofgs.ArgumentError, match=rf"^{name}\[3[],]") as caught:
        roofgs.Scene(**given)
    assert "byte" not in str(caught.value) and caught.value.offset is None
    assert caught.value.__suppress_context__  # the extension's own error, which knows no names


def test_logits_and_logarithms_are_named():
    with pytest.raises(roofgs.ArgumentError, match=r"opacities\[0\] is 3.0, not 0 to 1; of logits"):
        roofgs.Scene(**{**attributes(), "opacities": np.full(3, 3.0)})
    with pytest.raises(roofgs.ArgumentError, match=r"scales\[0, 0\] is -4.0, not 0 and above; of logarithms"):
        roofgs.Scene(**{**attributes(), "scales": np.full((3, 3), -4.0)})


@pytest.mark.parametrize("name, shape", [("means", (3, 2)), ("means", (9,)), ("quats", (3, 3)), ("scales", (2, 3)),
                                         ("opacities", (3, 1)), ("sh0", (3, 2, 3)), ("shN", (3, 7, 3))])
def test_wrong_shapes_are_refused_by_name(name, shape):
    with pytest.raises(roofgs.ArgumentError, match=name):
        roofgs.Scene(**{**attributes(), name: np.zeros(shape)})


def test_no_numbers_are_refused():
    with pytest.raises(roofgs.ArgumentError, match="means"):
        roofgs.Scene(**{**attributes(), "means": np.array([["a"] * 3] * 3)})
    with pytest.raises(roofgs.ArgumentError, match="scales"):
        roofgs.Scene(**{**attributes(), "scales": np.ones((3, 3), complex)})


def test_empty_scene(renderer):
    scene = roofgs.load(GOLDEN / "empty.rgs")
    assert len(scene) == 0 and scene.means.shape == (0, 3) and scene.shN.shape[0] == 0
    made = roofgs.Scene(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3)))
    camera = roofgs.Camera(8, 6, 10)
    assert not renderer.render(made, camera).any()
    assert "0 Gaussians" in repr(made) and "<img" not in made._repr_html_()


def test_origin_is_kept(tmp_path):
    scene = roofgs.Scene(**attributes(), origin=(1e7, -2e6, 3.5))
    assert scene.origin.tolist() == [1e7, -2e6, 3.5]
    scene.save(tmp_path / "far.rgs")
    again = roofgs.load(tmp_path / "far.rgs")
    np.testing.assert_allclose(np.sort(again.origin + again.means, axis=0), np.sort(scene.origin + scene.means, axis=0),
                               atol=1e-5)


def test_crs_is_read():
    assert roofgs.load(GOLDEN / "crs.rgs").crs.startswith("GEODCRS[")
    assert roofgs.load(GOLDEN / "origin.rgs").crs == ""


# ---- files


def by_place(scene):
    return np.lexsort(scene.means.T)


@pytest.mark.parametrize("name", ["a.rgs", "a.ply", "a.compressed.ply", "a.spz", "a.splat", "a.sog", "a.glb", "a.usda", "a.usdz",
                                  "a.npz"])
def test_saved_scenes_come_back(name, tmp_path, examples):
    scene = roofgs.load(examples / "scene.ply")
    n_bytes = scene.save(tmp_path / name)
    assert n_bytes == (tmp_path / name).stat().st_size
    again = roofgs.load(tmp_path / name)
    assert len(again) == len(scene) and again.format in name
    exact = name in ("a.rgs", "a.ply", "a.glb", "a.usda", "a.usdz", "a.npz")
    np.testing.assert_allclose(np.sort(again.means, axis=0), np.sort(scene.means, axis=0), atol=0 if exact else 0.3)  # of 600
    if name == "a.ply":
        for attribute in ("means", "sh"):
            assert np.array_equal(getattr(again, attribute), getattr(scene, attribute))
        np.testing.assert_allclose(again.quats, scene.quats, atol=2e-7)
        np.testing.assert_allclose(again.scales, scene.scales, rtol=3e-7)
        np.testing.assert_allclose(again.opacities, scene.opacities, rtol=1e-6)


def test_the_axes_of_spz_files_are_those_of_ply_unless_told_otherwise(tmp_path, examples):
    scene = roofgs.load(examples / "scene.ply")
    path = tmp_path / "a.spz"
    for written, read, sign in (("ply", "ply", 1), ("opengl", "opengl", 1), ("ply", "opengl", -1), ("opengl", "ply", -1)):
        scene.save(path, spz_axes=written, overwrite=True)
        again = roofgs.load(path, spz_axes=read)
        np.testing.assert_allclose(again.means, scene.means * [1, sign, sign], atol=1 / 4096)
    for wrong in (lambda: roofgs.load(path, spz_axes="3dgs"), lambda: scene.save(path, spz_axes="gltf", overwrite=True)):
        with pytest.raises(roofgs.ArgumentError, match="spz_axes is 'ply' or 'opengl'"):
            wrong()


@pytest.mark.parametrize("source", ["degree3.rgs", "packed_degree3.rgs", "origin.rgs", "edges.rgs"])
def test_a_file_that_is_saved_holds_the_same_gaussians(source, tmp_path):
    scene = roofgs.load(GOLDEN / source)
    scene.save(tmp_path / "again.rgs", profile="direct")
    again = roofgs.load(tmp_path / "again.rgs")
    a, b = by_place(scene), by_place(again)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(scene, name)[a], getattr(again, name)[b]), name
    assert np.array_equal(scene.origin, again.origin)


def test_profiles_and_levels(tmp_path, examples, scene):
    sizes = [scene.save(tmp_path / f"{profile}.rgs".replace(":", "_"), profile=profile)
             for profile in ("direct", "packed", "archive:high", "archive:small", "archive:tiny")]
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == 5
    scene.save(tmp_path / "levels.rgs", lod=True)
    assert roofgs.load(tmp_path / "levels.rgs").levels == roofgs.load(examples / "levels.rgs").levels > 1


def test_levels_are_read_alone(examples):
    whole = roofgs.load(examples / "levels.rgs")
    coarse = roofgs.load(examples / "levels.rgs", level_of_detail=1)
    few = roofgs.load(examples / "levels.rgs", max_count=1000)
    assert len(coarse) < len(whole) == 2000 and len(few) <= 1000
    with pytest.raises(roofgs.ArgumentError):
        roofgs.load(examples / "levels.rgs", level_of_detail=99)
    for wrong in (-1, 1 << 32, 1 << 64):
        with pytest.raises(roofgs.ArgumentError):
            roofgs.load(examples / "levels.rgs", level_of_detail=wrong)
    with pytest.raises(TypeError):
        roofgs.load(examples / "levels.rgs", level_of_detail=0.5)


def test_nothing_is_overwritten_unasked(tmp_path, scene):
    path = tmp_path / "a.rgs"
    path.write_bytes(b"mine")
    with pytest.raises(roofgs.OutputExistsError, match="overwrite=True") as caught:
        scene.save(path)
    assert isinstance(caught.value, FileExistsError) and caught.value.file == str(path)
    assert "--" not in str(caught.value) and path.read_bytes() == b"mine"
    scene.save(path, overwrite=True)
    assert len(roofgs.load(path)) == len(scene)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.rgs"]


@pytest.mark.parametrize("yes, no", [(1, 0), (np.bool_(True), np.bool_(False))])
def test_flags_are_true_or_false_as_python_has_it(yes, no, tmp_path, examples, scene):
    path = tmp_path / "a.rgs"
    for _ in range(2):
        scene.save(path, overwrite=yes, sync=no, strict=no)
    for flag in (yes, no):
        assert roofgs.info(path, verify=flag, statistics=flag) == roofgs.info(path, verify=bool(flag), statistics=bool(flag))
    with roofgs.StreamedScene(examples / "levels.rgs", prefetch=no) as streamed:
        assert len(streamed) == len(scene)
    for _ in range(2):
        roofgs.cameras.save(tmp_path / "a.json", [], overwrite=yes)
        roofgs.convert(examples / "scene.ply", tmp_path / "b.rgs", overwrite=yes)


def test_a_scene_replaces_its_own_file(tmp_path, scene, renderer):
    path = tmp_path / "a.rgs"
    n_bytes = scene.save(path, profile="direct")
    own = roofgs.load(path)  # mapped: its arrays are not made yet
    own.save(path, profile="archive:high", overwrite=True)
    assert np.array_equal(own.means[by_place(own)], scene.means[by_place(scene)])
    view = roofgs.cameras.default_view(own, width=32, height=24)
    assert np.array_equal(renderer.render(own, view), renderer.render(scene, view))
    assert path.stat().st_size < n_bytes / 2


@pytest.mark.parametrize("options", [dict(lod=True), dict(profile="direct"), dict(profile="archive:small")])
@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.glb"])
def test_options_that_a_format_does_not_have_are_refused(name, options, tmp_path, scene):
    with pytest.raises(roofgs.ArgumentError, match="for .rgs outputs"):
        scene.save(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_names_that_no_format_has(tmp_path, scene):
    for name in ("a.obj", "a", "a.pt"):
        with pytest.raises(roofgs.ArgumentError):
            scene.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_kinds_of_paths(tmp_path, scene, monkeypatch):
    strange = os.fsencode(tmp_path) + b"/caf\xe9 \xff.rgs"  # no UTF-8
    scene.save(strange)
    assert len(roofgs.load(strange)) == len(roofgs.load(os.fsdecode(strange))) == len(scene)
    assert roofgs.load(Path(os.fsdecode(strange))).path == os.fsdecode(strange)
    monkeypatch.chdir(tmp_path)
    scene.save("relative.rgs")
    assert len(roofgs.load("relative.rgs")) == len(scene)
    for bad in ("a\0b.rgs", b"a\0b.rgs"):
        with pytest.raises(ValueError, match="null"):
            roofgs.load(bad)
        with pytest.raises(ValueError, match="null"):
            scene.save(bad)
    with pytest.raises(TypeError):
        roofgs.load(3)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted([os.fsdecode(b"caf\xe9 \xff.rgs"), "relative.rgs"])


def test_progress_of_saving(tmp_path, scene):
    calls = []
    scene.save(tmp_path / "a.rgs", progress=lambda *facts: calls.append(facts))
    stages = [stage for stage, *_ in calls]
    assert "encode" in stages and all(isinstance(done, int) and done <= max(total, done) for _, done, total, _ in calls)
    encoded = [done for stage, done, total, _ in calls if stage == "encode"]
    assert encoded[-1] == len(scene)


def test_an_error_in_the_callback_gives_up(tmp_path, examples):
    scene = roofgs.load(examples / "scene.ply")

    def fail(*_):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        scene.save(tmp_path / "a.rgs", lod="best", progress=fail)
    assert not any(entry.name.startswith("a.rgs.tmp") for entry in tmp_path.iterdir())


def test_ctrl_c_leaves_a_whole_file_or_none(tmp_path, examples):
    scene = roofgs.load(examples / "scene.ply")
    ended = []
    for stage_of_signal in ("scan", "encode", "commit", "fit"):
        def interrupt(stage, *_, wanted=stage_of_signal):
            if stage == wanted:
                os.kill(os.getpid(), signal.SIGINT)

        path = tmp_path / f"{stage_of_signal}.rgs"
        try:
            scene.save(path, progress=interrupt)
            ended.append("saved")
        except KeyboardInterrupt:
            ended.append("interrupted")
        if path.exists():
            assert len(roofgs.load(path)) == len(scene)
    assert "interrupted" in ended and ended[-1] == "saved"
    assert all(entry.suffix == ".rgs" for entry in tmp_path.iterdir())


def test_ctrl_c_ends_the_fitting_of_levels(tmp_path):
    scene = roofgs.Scene(**attributes(n=60_000))

    def interrupt(stage, done, total, unit):
        if not any(tmp_path.iterdir()):
            return
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        scene.save(tmp_path / "a.rgs", lod="best", progress=interrupt)
    assert [entry.name for entry in tmp_path.iterdir()] in ([], ["a.rgs"])  # nothing is left half done


def test_threads_load_at_once():
    scenes = [None] * 8

    def load(i):
        scenes[i] = roofgs.load(GOLDEN / "degree3.rgs").means.sum()

    threads = [threading.Thread(target=load, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(scenes)) == 1


# ---- shown


def test_repr():
    assert repr(roofgs.load(GOLDEN / "degree3.rgs")) == f"<roofgs.Scene 40 Gaussians, SH degree 3, from {str(GOLDEN / 'degree3.rgs')!r}>"


def test_html_has_a_picture_and_escapes_names(tmp_path, scene):
    import base64

    path = tmp_path / "<script>&.rgs"
    scene.save(path)
    page = roofgs.load(path)._repr_html_()
    assert "<script>" not in page and "&lt;script&gt;&amp;" in page
    data = base64.b64decode(page.split("base64,")[1].split('"')[0])
    assert data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")


def test_addresses_are_shown_without_secrets():
    from roofgs._paths import shown

    assert shown(b"https://me:secret@host/a/b.rgs?token=1#x") == "https://host/a/b.rgs"
    assert shown(b"http://host") == "http://host" and shown(b"a?b@c.rgs") == "a?b@c.rgs"


def test_info(tmp_path, scene):
    facts = roofgs.info(GOLDEN / "levels_packed.rgs", verify=True)
    assert facts["schema"].startswith("rgs-info/") and facts["header"]["n_gaussians"] > 0
    damaged = bytearray((GOLDEN / "degree3.rgs").read_bytes())
    damaged[-20] ^= 0x40
    (tmp_path / "damaged.rgs").write_bytes(damaged)
    with pytest.raises(roofgs.FormatError) as caught:
        roofgs.info(tmp_path / "damaged.rgs", verify=True)
    assert caught.value.code == "checksum_mismatch" and caught.value.expected != caught.value.found is not None


def test_scenes_are_not_pickled_by_accident(scene, renderer):
    with pytest.raises(TypeError, match="path"):
        pickle.dumps(scene)
    with pytest.raises(TypeError, match="make another"):
        pickle.dumps(renderer)


def test_copies_of_what_never_changes_are_itself(scene):
    assert copy.copy(scene) is scene and copy.deepcopy({"scene": scene})["scene"] is scene


@pytest.mark.parametrize("anti_aliasing, low_pass, declared", [("classic", None, 0.3), ("mip", None, 0.1), ("mip", 0.25, 0.25)])
def test_low_pass_comes_back(anti_aliasing, low_pass, declared, tmp_path):
    scene = roofgs.Scene(**attributes(), anti_aliasing=anti_aliasing, low_pass=low_pass)
    scene.save(tmp_path / "a.rgs")
    assert scene.low_pass == roofgs.load(tmp_path / "a.rgs").low_pass == np.float32(declared)
