"""Cameras. SPDX-License-Identifier: Apache-2.0"""
import copy
import json
import math
import pickle

import numpy as np
import pytest

import roofgs
from roofgs import cameras


def turned():
    """A camera without any symmetry: turned about all axes, off the middle, with unequal focal lengths."""
    a, b, c = 0.3, -0.7, 1.1
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    view = np.eye(4)
    view[:3, :3] = z @ y @ x
    view[:3, 3] = (0.4, -0.2, 3.0)
    return view


def test_camera_keeps_what_it_is_given():
    camera = roofgs.Camera(70, 50, 60.5, 80.25, 30.0, 20.0, turned(), name="left")
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.name) == \
        (70, 50, 60.5, 80.25, 30.0, 20.0, "left")
    assert np.array_equal(camera.world_to_camera, turned())
    np.testing.assert_allclose(turned() @ [*camera.centre, 1], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(camera.axis(2), turned()[2, :3])


def test_defaults():
    camera = roofgs.Camera(70, 50, 60)
    assert (camera.fy, camera.cx, camera.cy) == (60, 35, 25) and np.array_equal(camera.world_to_camera, np.eye(4))


@pytest.mark.parametrize("width", [0, -1, 65537, 2**31, 2**32 + 64, 2**64 + 64, 10**30])
def test_sides_that_no_picture_has(width):
    for sides in ((width, 50), (50, width)):
        with pytest.raises(roofgs.ArgumentError) as caught:
            roofgs.Camera(*sides, 60)
        assert caught.value.code == "bad_camera"
        with pytest.raises(roofgs.ArgumentError):
            roofgs.Camera(8, 8, 60).resized(*sides)
        with pytest.raises(roofgs.ArgumentError):
            cameras.look_at((0, 0, 0), (0, 0, 1), width=sides[0], height=sides[1])


def test_sides_are_integers():
    assert roofgs.Camera(np.int64(70), np.uint8(50), 60).width == 70
    with pytest.raises(TypeError):
        roofgs.Camera(70.5, 50, 60)


@pytest.mark.parametrize("change", [dict(fx=np.nan), dict(fx=-1.0), dict(fy=np.inf), dict(cx=np.nan),
                                    dict(world_to_camera=np.full((4, 4), np.nan)), dict(world_to_camera=2 * np.eye(4)),
                                    dict(world_to_camera=np.diag([1, 1, -1, 1])), dict(world_to_camera=np.eye(3))])
def test_bad_cameras_are_refused(change):
    with pytest.raises(roofgs.ArgumentError) as caught:
        roofgs.Camera(**{**dict(width=8, height=8, fx=10.0), **change})
    assert caught.value.code == "bad_camera"


def test_matrices_in_any_layout():
    view = turned()
    for other in (np.asfortranarray(view), view.astype(">f8"), np.repeat(view, 2, axis=1)[:, ::2]):
        assert np.array_equal(roofgs.Camera(8, 8, 10, world_to_camera=other).world_to_camera, view)


def test_equality_hash_and_pickle():
    a = roofgs.Camera(70, 50, 60.5, 80.25, 30.0, 20.0, turned(), name="left")
    b = roofgs.Camera(70, 50, 60.5, 80.25, 30.0, 20.0, turned(), name="left")
    again = pickle.loads(pickle.dumps(a))
    assert a == b == again and hash(a) == hash(again) and a != roofgs.Camera(70, 50, 60.5) and a != 3
    assert "left" in repr(a) and "70x50" in repr(a)


def test_files(examples):
    loaded = cameras.load(examples / "cameras.json")
    assert loaded.source == "list" and not loaded.split_declared and len(loaded) == 8
    assert [camera.name for camera in loaded.test] == [sorted(camera.name for camera in loaded)[0]]
    assert len(loaded.train) == 7 and loaded.named(loaded[3].name) == loaded[3]
    assert pickle.loads(pickle.dumps(loaded)) == loaded and pickle.loads(pickle.dumps(loaded)).test == loaded.test
    with pytest.raises(KeyError):
        loaded.named("nobody")
    with pytest.raises(FileNotFoundError):
        cameras.load(examples / "none.json")


def test_a_declared_split_is_kept(examples, tmp_path):
    views = [roofgs.Camera(8, 8, 10, name=name) for name in "abca"]  # the first and the last are equal
    declared = cameras.CameraList(views, [False, True, False, True], "list", True)
    for again in (pickle.loads(pickle.dumps(declared)), copy.copy(declared), copy.deepcopy(declared)):
        assert again == declared and again.split_declared and again.source == "list"
        assert [camera.name for camera in again.test] == ["b", "a"] and [camera.name for camera in again.train] == ["a", "c"]
    declared.reverse()
    declared.append(roofgs.Camera(8, 8, 10, name="of neither part"))
    cameras.save(tmp_path / "declared.json", declared)
    rows = json.loads((tmp_path / "declared.json").read_text())
    assert [(row["name"], row.get("split")) for row in rows] == \
        [("a", "test"), ("c", "train"), ("b", "test"), ("a", "train"), ("of neither part", None)]
    del rows[0]["split"], rows[1]["split"]  # of some cameras alone
    (tmp_path / "partly.json").write_text(json.dumps(rows))
    partly = cameras.load(tmp_path / "partly.json")
    cameras.save(tmp_path / "again.json", partly)
    assert [camera.name for camera in partly.test] == ["b"] == [camera.name for camera in cameras.load(tmp_path / "again.json").test]
    cameras.save(tmp_path / "undeclared.json", cameras.load(examples / "cameras.json"))
    assert "split" not in (tmp_path / "undeclared.json").read_text()


def test_saving_replaces_nothing_unasked(tmp_path, monkeypatch):
    path = tmp_path / "one.json"
    cameras.save(path, roofgs.Camera(8, 8, 10, name="one"))
    with pytest.raises(roofgs.OutputExistsError, match="overwrite=True"):
        cameras.save(path, [])
    assert [camera.name for camera in cameras.load(path)] == ["one"]
    cameras.save(path, [roofgs.Camera(8, 8, 10, name="two")], overwrite=True)
    assert [camera.name for camera in cameras.load(path)] == ["two"]
    with pytest.raises(roofgs.MissingFileError):
        cameras.save(tmp_path / "none" / "one.json", [])
    monkeypatch.chdir(tmp_path)
    cameras.save("-", roofgs.Camera(8, 8, 10))  # no standard stream
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["-", "one.json"]


def test_models_are_saved_and_loaded(tmp_path):
    views = [roofgs.Camera(64, 48, 50, name="lens", model="opencv", distortion=(0.1, -0.02, 1e-3, -2e-3, 0.003, 0.004, 0.005, 0.006)),
             roofgs.Camera(64, 48, 20, name="fisheye", model="opencv_fisheye", distortion=(0.1, -0.02)),
             roofgs.Camera(64, 32, 64 / (2 * math.pi), name="panorama", model="equirectangular"),
             roofgs.Camera(64, 48, 20, name="map", model="orthographic"), roofgs.Camera(64, 48, 50, name="pinhole")]
    assert views[1].distortion == (0.1, -0.02, 0, 0, 0, 0, 0, 0) and views[4].model == "pinhole"
    cameras.save(tmp_path / "models.json", views)
    assert cameras.load(tmp_path / "models.json") == views == pickle.loads(pickle.dumps(views))
    assert views[0].resized(32, 24).distortion == views[0].distortion
    for wrong in (dict(model="OPENCV"), dict(distortion=(0.1,)), dict(model="opencv", distortion=[0] * 9),
                  dict(model="opencv_fisheye", distortion=(0, 0, 0, 0, 1)), dict(model="equirectangular")):
        with pytest.raises(roofgs.ArgumentError) as caught:
            roofgs.Camera(64, 48, 5, **wrong)
        assert caught.value.code == "bad_camera"


def test_names_that_are_no_text(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_bytes(b"1 1 0 0 0 0 0 0 1 caf\xe9.jpg\n\n")
    [camera] = cameras.load(tmp_path)
    assert camera.name == "caf\ufffd.jpg" and "caf" in repr(camera)
    assert pickle.loads(pickle.dumps(camera)) == camera and hash(camera) == hash(pickle.loads(pickle.dumps(camera)))
    cameras.save(tmp_path / "saved.json", [camera])
    assert cameras.load(tmp_path / "saved.json") == [camera]


def test_names_of_any_text():
    for name in ("zero \0 byte", "half of a pair \ud800"):
        assert roofgs.Camera(8, 8, 10, name=name).name == name
        with pytest.raises(roofgs.ArgumentError) as caught:
            roofgs.Camera(8, 8, -1, name=name)
        assert (caught.value.code, caught.value.file) == ("bad_camera", name)
    for name in (None, 3, b"bytes"):
        with pytest.raises(TypeError, match="a str, not"):
            roofgs.Camera(8, 8, 10, name=name)


def test_views_and_paths(scene):
    views = cameras.orbit(scene, 5, width=64, height=48)
    assert len(views) == 5 and views[0] == cameras.default_view(scene, width=64, height=48)
    assert len(cameras.path(views, 9)) == 9
    low, high = scene.bounds
    middle = (np.array(low) + high) / 2
    for view in views:  # the middle of the scene is seen in the middle of the picture
        seen = view.world_to_camera @ [*middle, 1]
        np.testing.assert_allclose(seen[:2], 0, atol=1e-3)
        assert seen[2] > 0
    with pytest.raises(roofgs.ArgumentError):
        cameras.path([], 3)
    for n in (0, -1, 1 << 31, (1 << 32) + 1, 1 << 64):
        for several in (lambda: cameras.orbit(scene, n), lambda: cameras.path(views, n)):
            with pytest.raises(roofgs.ArgumentError, match=f"cameras, not {n}"):
                several()


def test_a_file_states_the_first_view_of_the_scene(scene, tmp_path):
    view = cameras.default_view(scene)
    scene.save(tmp_path / "archive.rgs", profile="archive:small")
    kept = cameras.default_view(roofgs.load(tmp_path / "archive.rgs"))
    np.testing.assert_allclose(kept.world_to_camera, view.world_to_camera, atol=1e-3)
    roofgs.load(tmp_path / "archive.rgs").save(tmp_path / "levels.rgs", lod="fast")
    assert cameras.default_view(roofgs.load(tmp_path / "levels.rgs")) == kept


def test_matrices_of_gsplat():
    k = np.array([[60.5, 0, 30], [0, 80.25, 20], [0, 0, 1]])
    [camera] = cameras.from_matrices(turned()[None], k[None], 70, 50)
    assert camera == roofgs.Camera(70, 50, 60.5, 80.25, 30, 20, turned())
    skewed = k.copy()
    skewed[0, 1] = 0.1
    with pytest.raises(roofgs.ArgumentError, match="skew"):
        cameras.from_matrices(turned()[None], skewed[None], 70, 50)
    with pytest.raises(roofgs.ArgumentError):
        cameras.from_matrices(turned(), k[None], 70, 50)
