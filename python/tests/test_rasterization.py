"""rasterization(), against the formulas that gsplat documents. SPDX-License-Identifier: Apache-2.0"""
import math
import pickle
import warnings

import numpy as np
import pytest
from test_cameras import turned

import roofgs

W, H = 48, 36
K = np.array([[40.0, 0, 21.0], [0, 52.0, 19.0], [0, 0, 1]])


def second_view():
    view = turned().copy()
    view[:3, 3] += (0.3, 0.2, 0.5)
    return view


def splats(n=12, seed=5):
    r = np.random.default_rng(seed)
    return dict(means=r.normal(scale=0.6, size=(n, 3)), quats=r.normal(size=(n, 4)), scales=r.uniform(0.03, 0.35, (n, 3)),
                opacities=r.uniform(0.2, 0.95, n), colors=r.uniform(0.0, 1.2, (n, 3)))


CAMERAS = dict(viewmats=np.stack([turned(), second_view()]), Ks=np.stack([K, K]), width=W, height=H)


def projected(means, quats, scales, opacities, view, k, eps2d=0.3, antialiased=False, near=0.01, clamp=True):
    """Centre, z, covariance and opacity of each Gaussian on the image in FP64, None if it is too near: Zwicker's EWA splatting
    as 3DGS and gsplat define it."""
    half = np.array([W / k[0, 0], H / k[1, 1]]) / 2  # pictures, as slopes
    low = -k[:2, 2] / np.diag(k)[:2] - 0.3 * half
    high = low + 2.6 * half
    q = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = q.T
    rotation = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1).reshape(-1, 3, 3)
    axes = rotation * scales[:, None, :]
    covariance = axes @ axes.transpose(0, 2, 1)
    at = means @ view[:3, :3].T + view[:3, 3]
    found = []
    for i in range(len(means)):
        px, py, pz = at[i]
        if pz < near:
            found.append(None)
            continue
        sx, sy = np.clip((px / pz, py / pz), low, high) if clamp else (px / pz, py / pz)
        jacobian = np.array([[k[0, 0], 0, -k[0, 0] * sx], [0, k[1, 1], -k[1, 1] * sy]]) / pz
        m = jacobian @ view[:3, :3]
        before = m @ covariance[i] @ m.T
        after = before + eps2d * np.eye(2)
        share = np.sqrt(max(np.linalg.det(before) / np.linalg.det(after), 0)) if antialiased else 1
        found.append((np.array([k[0, 0] * px / pz + k[0, 2], k[1, 1] * py / pz + k[1, 2]]), pz, after, opacities[i] * share))
    return found


def expected(means, quats, scales, opacities, colors, view, k, **options):
    """Colours, alpha and accumulated depth in FP64, pixel by pixel."""
    found = projected(means, quats, scales, opacities, view, k, **options)
    v, u = np.mgrid[0:H, 0:W] + 0.5
    colour, depth, left = np.zeros((H, W, colors.shape[-1])), np.zeros((H, W)), np.ones((H, W))
    for i in sorted((i for i, each in enumerate(found) if each), key=lambda i: found[i][1]):
        centre, pz, covariance, weight = found[i]
        d = np.stack([u - centre[0], v - centre[1]], axis=-1)
        distance = np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(covariance), d)
        alpha = np.minimum(weight * np.exp(-distance / 2), 0.99)
        alpha = np.where((alpha >= 1 / 255) & (left > 1e-4), alpha, 0)
        colour += (alpha * left)[..., None] * colors[i]
        depth += alpha * left * pz
        left *= 1 - alpha
    return colour, 1 - left, depth


def close(a, b):
    """All but the pixels at a Gaussian's edge: where it ends, one step of 1/255 and what is behind it are decided."""
    difference = np.abs(np.asarray(a, dtype=np.float64) - b)
    assert np.quantile(difference, 0.98) < 2e-5, np.quantile(difference, [0.5, 0.9, 0.98, 1])
    assert difference.max() < 0.03 * max(1, np.abs(b).max())


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.3, 0.8])
def test_pictures_alpha_and_depth(antialiased, eps2d):
    given = splats()
    colors, alphas, meta = roofgs.rasterization(**given, **CAMERAS, render_mode="RGB+D", eps2d=eps2d,
                                                rasterize_mode="antialiased" if antialiased else "classic")
    assert colors.shape == (2, H, W, 4) and alphas.shape == (2, H, W, 1) and colors.dtype == np.float32
    assert {name: meta[name] for name in ("width", "height", "n_cameras", "n_batches")} == \
        dict(width=W, height=H, n_cameras=2, n_batches=1)
    for c in range(2):
        colour, alpha, depth = expected(**given, view=CAMERAS["viewmats"][c], k=K, eps2d=eps2d, antialiased=antialiased)
        assert alpha.max() > 0.8
        close(colors[c, ..., :3], colour)
        close(alphas[c, ..., 0], alpha)
        close(colors[c, ..., 3], depth)


def test_render_modes():
    given = {**splats(), **CAMERAS}
    rgb, alphas, _ = roofgs.rasterization(**given)
    both, _, _ = roofgs.rasterization(**given, render_mode="RGB+D")
    both_expected, _, _ = roofgs.rasterization(**given, render_mode="RGB+ED")
    depth, depth_alphas, _ = roofgs.rasterization(**given, render_mode="D")
    expected_depth, _, _ = roofgs.rasterization(**given, render_mode="ED")
    assert rgb.shape[-1] == 3 and both.shape[-1] == both_expected.shape[-1] == 4 and depth.shape[-1] == 1
    assert np.array_equal(both[..., :3], rgb) and np.array_equal(both_expected[..., :3], rgb)
    assert np.array_equal(both[..., 3:], depth) and np.array_equal(both_expected[..., 3:], expected_depth)
    assert np.array_equal(alphas, depth_alphas)
    np.testing.assert_allclose(depth, expected_depth * alphas, rtol=1e-6)
    assert expected_depth[alphas > 0.5].min() > 1


def test_backgrounds_are_behind_colours_alone():
    given = {**splats(), **CAMERAS}
    backgrounds = np.array([[0.5, 1.0, 0.0], [0.25, 0.0, 2.0]])
    plain, alphas, _ = roofgs.rasterization(**given, render_mode="RGB+D")
    over, _, _ = roofgs.rasterization(**given, render_mode="RGB+D", backgrounds=backgrounds)
    np.testing.assert_allclose(over[..., :3], plain[..., :3] + (1 - alphas) * backgrounds[:, None, None], atol=1e-6)
    assert np.array_equal(over[..., 3], plain[..., 3])
    with pytest.raises(roofgs.ArgumentError, match="backgrounds"):
        roofgs.rasterization(**given, backgrounds=backgrounds[0])


@pytest.mark.parametrize("n_channels", [1, 2, 3, 4, 7])
def test_any_number_of_channels(n_channels):
    given = {**splats(), **CAMERAS}
    r = np.random.default_rng(2)
    given["colors"] = r.uniform(0, 3, (12, n_channels))
    backgrounds = r.uniform(0, 1, (2, n_channels))
    colors, _, _ = roofgs.rasterization(**given, backgrounds=backgrounds, render_mode="RGB+D")
    assert colors.shape == (2, H, W, n_channels + 1)
    del given["viewmats"], given["Ks"], given["width"], given["height"]
    colour, alpha, depth = expected(**given, view=turned(), k=K)
    close(colors[0, ..., :n_channels], colour + (1 - alpha)[..., None] * backgrounds[0])
    close(colors[0, ..., n_channels], depth)


def test_features_below_0():
    given = {**splats(), **CAMERAS}
    features = np.random.default_rng(8).normal(scale=3, size=(2, 12, 4))
    features[:, :, 2] = abs(features[:, :, 2])
    backgrounds = np.array([[-1.0, 2, 0, 0.5], [0, -3, 1, 0]])
    both, alphas, _ = roofgs.rasterization(**{**given, "colors": features}, backgrounds=backgrounds, render_mode="RGB+ED")
    first, _, _ = roofgs.rasterization(**{**given, "colors": features[0]}, backgrounds=backgrounds, render_mode="RGB+ED")
    assert np.array_equal(first[0], both[0]) and both[..., 0].min() < -1
    del given["viewmats"], given["Ks"], given["width"], given["height"]
    for c in range(2):
        colour, alpha, depth = expected(**{**given, "colors": features[c]}, view=CAMERAS["viewmats"][c], k=K)
        np.testing.assert_allclose(alphas[c, ..., 0], alpha, atol=0.02)
        close(both[c, ..., :4], colour + (1 - alpha)[..., None] * backgrounds[c])
        assert (both[c, ..., 4] >= 0).all() and np.array_equal(both[c, ..., 4] > 0, alphas[c, ..., 0] > 0)


def test_features_that_cannot_be_raised_are_named():
    given = {**splats(), **CAMERAS}
    given["colors"] = np.ones((12, 4), np.float32)
    given["colors"][3, 3], given["colors"][7, 3] = -3e38, 3e38
    with pytest.raises(roofgs.ArgumentError, match=r"colors.*channel 3") as caught, warnings.catch_warnings():
        warnings.simplefilter("error")
        roofgs.rasterization(**given)
    assert caught.value.__context__ is None


def test_features_below_0_are_exact_to_a_millionth_of_the_lowest():
    given = {**splats(), **CAMERAS}
    plain, _, _ = roofgs.rasterization(**given)
    given["opacities"][5] = 0
    without, _, _ = roofgs.rasterization(**given)
    given["colors"] = given["colors"].copy()
    given["colors"][5, 1] = -1e5  # which nobody sees
    raised, _, _ = roofgs.rasterization(**given)
    assert not np.array_equal(plain, without)
    np.testing.assert_allclose(raised, without, rtol=0, atol=0.1)
    assert np.array_equal(raised[..., ::2], without[..., ::2])


def basis(d, degree):
    """Real spherical harmonics by their definition, with the phase of Condon and Shortley: [n, (degree + 1)^2]."""
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T
    phi, sine = np.arctan2(y, x), np.hypot(x, y)
    legendre = {(0, 0): np.ones_like(z)}
    for m in range(1, degree + 1):
        legendre[m, m] = -(2 * m - 1) * sine * legendre[m - 1, m - 1]
    for m in range(degree):
        legendre[m + 1, m] = (2 * m + 1) * z * legendre[m, m]
        for n in range(m + 2, degree + 1):
            legendre[n, m] = ((2 * n - 1) * z * legendre[n - 1, m] - (n + m - 1) * legendre[n - 2, m]) / (n - m)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            a = abs(m)
            norm = np.sqrt((2 * n + 1) / (4 * np.pi) * math.factorial(n - a) / math.factorial(n + a))
            angle = np.ones_like(phi) if m == 0 else np.sqrt(2) * (np.cos(a * phi) if m > 0 else np.sin(a * phi))
            columns.append(norm * angle * legendre[n, a])
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_harmonics_by_their_definition(sh_degree):
    given = {**splats(n=24), **CAMERAS}
    sh = np.random.default_rng(4).normal(scale=0.3, size=(24, 16, 3))
    colors, _, _ = roofgs.rasterization(**{**given, "colors": sh}, sh_degree=sh_degree)
    for c in range(2):
        view = CAMERAS["viewmats"][c]
        y = basis(given["means"] + view[:3, :3].T @ view[:3, 3], sh_degree)
        seen = np.maximum(0.5 + np.einsum("nk,nkc->nc", y, sh[:, :y.shape[1]]), 0)
        colour, _, _ = expected(given["means"], given["quats"], given["scales"], given["opacities"], seen, view, K)
        close(colors[c], colour)


def test_gaussians_at_the_edges_of_an_eccentric_view():
    # Most centres lie beyond the picture, where gsplat holds the slopes of the projection's derivative back.
    given = splats(n=40, seed=9)
    given["means"] = given["means"] * (2.5, 2.0, 0.3) + (0.0, 0.0, 1.2)
    given["scales"] *= 3
    k = np.array([[30.0, 0, 5.0], [0, 33.0, 30.0], [0, 0, 1]])
    colors, alphas, _ = roofgs.rasterization(**given, viewmats=np.eye(4)[None], Ks=k[None], width=W, height=H)
    colour, alpha, _ = expected(**given, view=np.eye(4), k=k)
    unclamped, _, _ = expected(**given, view=np.eye(4), k=k, clamp=False)
    close(colors[0], colour)
    close(alphas[0, ..., 0], alpha)
    assert np.abs(colour - unclamped).max() > 0.05


def test_poses_in_float32():
    r = np.random.default_rng(11)
    given = splats()
    for _ in range(20):
        turn, _ = np.linalg.qr(r.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn * np.linalg.det(turn), r.normal(scale=30, size=3)
        view = np.linalg.inv(pose.astype(np.float32))
        assert view.dtype == np.float32
        roofgs.rasterization(**given, viewmats=view[None], Ks=K[None], width=W, height=H)


def test_harmonics_are_those_of_3dgs_and_degrees_above_are_ignored():
    given = {**splats(), **CAMERAS}
    sh = np.random.default_rng(3).normal(scale=0.4, size=(12, 16, 3))
    given["colors"] = sh
    one, _, _ = roofgs.rasterization(**given, sh_degree=1)
    cut, _, _ = roofgs.rasterization(**{**given, "colors": sh[:, :4]}, sh_degree=1)
    assert np.array_equal(one, cut)
    # Degree 1 by hand: 0.5 + c0 sh0 - c1 y sh1 + c1 z sh2 - c1 x sh3, direction from the camera, clamped at 0.
    centre = -turned()[:3, :3].T @ turned()[:3, 3]
    d = given["means"] - centre
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    colour = 0.5 + c0 * sh[:, 0] + c1 * (-y[:, None] * sh[:, 1] + z[:, None] * sh[:, 2] - x[:, None] * sh[:, 3])
    plain, _, _ = roofgs.rasterization(**{**given, "colors": np.maximum(colour, 0), "viewmats": turned()[None], "Ks": K[None]})
    np.testing.assert_allclose(one[0], plain[0], atol=2e-6)
    three, _, _ = roofgs.rasterization(**given, sh_degree=3)
    assert np.abs(three - one).max() > 0.01
    with pytest.raises(roofgs.ArgumentError, match="coefficients"):
        roofgs.rasterization(**{**given, "colors": sh[:, :8]}, sh_degree=2)


def test_colours_of_each_camera():
    given = {**splats(), **CAMERAS}
    others = np.stack([given["colors"], 1.2 - given["colors"]])
    both, _, _ = roofgs.rasterization(**{**given, "colors": others})
    for c in range(2):
        single, _, _ = roofgs.rasterization(**{**given, "colors": others[c], "viewmats": CAMERAS["viewmats"][c:c + 1],
                                               "Ks": K[None]})
        assert np.array_equal(both[c], single[0])


def test_batches_of_scenes():
    scenes = [splats(seed=seed) for seed in (1, 2, 3, 4, 5, 6)]
    given = {name: np.stack([scene[name] for scene in scenes]).reshape(2, 3, *scenes[0][name].shape) for name in scenes[0]}
    viewmats = np.broadcast_to(CAMERAS["viewmats"], (2, 3, 2, 4, 4)).copy()
    viewmats[:, :, :, 2, 3] += np.arange(6).reshape(2, 3, 1) / 4
    ks = np.broadcast_to(CAMERAS["Ks"], (2, 3, 2, 3, 3))
    colors, alphas, meta = roofgs.rasterization(**given, viewmats=viewmats, Ks=ks, width=W, height=H)
    assert colors.shape == (2, 3, 2, H, W, 3) and alphas.shape == (2, 3, 2, H, W, 1) and meta["n_batches"] == 6
    for i, scene in enumerate(scenes):
        single, _, _ = roofgs.rasterization(**scene, **{**CAMERAS, "viewmats": viewmats[i // 3, i % 3]})
        assert np.array_equal(colors[i // 3, i % 3], single)


@pytest.mark.parametrize("sh_degree, own", [(None, (5,)), (2, (16, 3))])
@pytest.mark.parametrize("of_cameras", [False, True])
def test_batches_are_their_pictures_one_by_one(sh_degree, own, of_cameras):
    r = np.random.default_rng(6)
    scenes = [splats(seed=seed) for seed in (1, 2)]
    given = {name: np.stack([scene[name] for scene in scenes]) for name in ("means", "quats", "scales", "opacities")}
    colors = r.normal(size=(2, *((2,) if of_cameras else ()), 12, *own))
    behind = r.uniform(size=(2, 2, 3 if sh_degree else own[0]))
    views, ks = (np.stack([CAMERAS[name], CAMERAS[name][::-1]]) for name in ("viewmats", "Ks"))
    options = dict(width=W, height=H, sh_degree=sh_degree, render_mode="RGB+ED", rasterize_mode="antialiased")
    both, alphas, _ = roofgs.rasterization(**given, colors=colors, viewmats=views, Ks=ks, backgrounds=behind, **options)
    pictures = []
    for b in range(2):
        for c in range(2):
            one = {name: value[b] for name, value in given.items()}
            picture, alpha, _ = roofgs.rasterization(**one, colors=colors[b, c] if of_cameras else colors[b], **options,
                                                     viewmats=views[b, c][None], Ks=K[None], backgrounds=behind[b, c][None])
            assert np.array_equal(both[b, c], picture[0]) and np.array_equal(alphas[b, c], alpha[0])
            pictures.append(picture.tobytes())
    assert len(set(pictures)) == 4


@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("sh_degree", [None, 0])
def test_no_gaussians_are_the_background(batch, sh_degree):
    nothing = {name: np.zeros((*batch, 0, *own), np.float32) for name, own in
               dict(means=(3,), quats=(4,), scales=(3,), opacities=(), colors=(3,) if sh_degree is None else (1, 3)).items()}
    views = {name: np.broadcast_to(CAMERAS[name], (*batch, *CAMERAS[name].shape)) for name in ("viewmats", "Ks")}
    behind = np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (*batch, 2, 3))
    colors, alphas, _ = roofgs.rasterization(**nothing, **views, width=W, height=H, sh_degree=sh_degree, backgrounds=behind,
                                             render_mode="RGB+ED")
    assert colors.shape == (*batch, 2, H, W, 4) and alphas.shape == (*batch, 2, H, W, 1) and not alphas.any()
    assert (colors == np.float32([0.25, 0.5, 0.75, 0])).all()


def test_near_and_far_planes():
    given = splats(n=2)
    given["means"] = np.array([[0, 0, 0.1], [1.5, 0, 5.0]])
    given["scales"][:] = [[0.002], [0.01]]
    one = dict(viewmats=np.eye(4)[None], Ks=K[None], width=W, height=H)
    depth = lambda **options: roofgs.rasterization(**given, **one, render_mode="ED", **options)[0].max()  # noqa: E731
    assert depth() == pytest.approx(5.0, rel=1e-5)
    assert depth(far_plane=1.0) == pytest.approx(0.1, rel=1e-5)
    _, near_alpha, _ = roofgs.rasterization(**given, **one, near_plane=0.2)
    _, all_alpha, _ = roofgs.rasterization(**given, **one)
    assert all_alpha.sum() > near_alpha.sum() > 0


def test_quaternions_need_no_norm():
    given = splats()
    longer = {**given, "quats": given["quats"] * 3}
    np.testing.assert_allclose(roofgs.rasterization(**longer, **CAMERAS)[0], roofgs.rasterization(**given, **CAMERAS)[0],
                               atol=1e-4)


@pytest.mark.parametrize("absent", [dict(absgrad=True), dict(sparse_grad=True), dict(radius_clip=3.0),
                                    dict(distributed=True), dict(camera_model="fisheye"), dict(covars=np.zeros((12, 3, 3))),
                                    dict(with_ut=True), dict(radial_coeffs=np.zeros(4)), dict(viewmats_rs=np.eye(4)),
                                    dict(camera_model="ortho"), dict(global_z_order=False)])
def test_what_is_not_there_is_said(absent):
    with pytest.raises(NotImplementedError, match=next(iter(absent))) as caught:
        roofgs.rasterization(**splats(), **CAMERAS, **absent)
    assert len(str(caught.value)) < 150 and "\n" not in str(caught.value)


def test_what_has_no_effect_is_taken():
    given = {**splats(), **CAMERAS}
    first = roofgs.rasterization(**given)[0]
    other = roofgs.rasterization(**given, packed=False, tile_size=8, channel_chunk=3, segmented=True, with_ut=False,
                                 global_z_order=True)[0]
    assert np.array_equal(first, other)


@pytest.mark.parametrize("wrong", [dict(render_mode="N"), dict(rasterize_mode="fast"), dict(sh_degree=4), dict(width=0),
                                   dict(width=2**32 + 48), dict(colors=np.full((12, 3), np.nan)), dict(colors=np.ones((11, 3))),
                                   dict(means=np.full((12, 3), np.nan)), dict(opacities=np.full(12, 2.0)),
                                   dict(viewmats=np.eye(4)), dict(Ks=np.eye(3)), dict(eps2d=-1.0), dict(near_plane=np.nan)])
def test_wrong_arguments(wrong):
    with pytest.raises(roofgs.Error):
        roofgs.rasterization(**{**splats(), **CAMERAS, **wrong})


@pytest.mark.parametrize("eps2d", ["x", None, [0.3, 0.3]])
def test_low_passes_are_numbers(eps2d):
    with pytest.raises((TypeError, ValueError)) as caught:
        roofgs.rasterization(**splats(), **CAMERAS, eps2d=eps2d)
    assert "from_arrays" not in str(caught.value) and len(str(caught.value)) < 150


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.3, 0.8])
def test_meta_of_each_gaussian(antialiased, eps2d):
    given = splats(60)
    given["means"] *= 2  # some beside the picture
    given["means"][8:11] -= 30 * turned()[2, :3]  # behind the cameras
    given["opacities"][::7] = 0.003
    given["opacities"][3] = 1
    _, _, meta = roofgs.rasterization(**given, **CAMERAS, eps2d=eps2d, packed=False,
                                      rasterize_mode="antialiased" if antialiased else "classic")
    assert meta["radii"].shape == (2, 60, 2) and meta["radii"].dtype == np.int32
    assert meta["batch_ids"] is meta["camera_ids"] is meta["gaussian_ids"] is None
    del given["colors"]
    counts = dict(drawn=0, faint=0, beside=0, behind=0)
    for c, view in enumerate(CAMERAS["viewmats"]):
        for i, each in enumerate(projected(**given, view=view, k=K, eps2d=eps2d, antialiased=antialiased)):
            radii = [0, 0]
            if each is None:
                counts["behind"] += 1
            elif each[3] < 1 / 255:
                counts["faint"] += 1
            else:
                box = np.ceil(np.sqrt(2 * np.log(255 * each[3]) * np.diag(each[2])))
                is_beside = (each[0] + box <= 0).any() or (each[0] - box >= (W, H)).any()
                counts["beside" if is_beside else "drawn"] += 1
                radii = [0, 0] if is_beside else box
            np.testing.assert_array_equal(meta["radii"][c, i], radii)
            shown = {name: meta[name][c, i] for name in ("means2d", "depths", "conics", "opacities")}
            if not any(radii):
                assert not any(shown[name].any() for name in ("means2d", "depths", "conics"))
                assert shown["opacities"] == np.float32(given["opacities"][i])
                continue
            (a, b), (_, d) = np.linalg.inv(each[2])
            np.testing.assert_allclose(shown["means2d"], each[0], rtol=1e-4, atol=1e-3)
            np.testing.assert_allclose(shown["depths"], each[1], rtol=1e-5)
            np.testing.assert_allclose(shown["conics"], (a, b, d), rtol=1e-4, atol=1e-5 * max(a, d))
            np.testing.assert_allclose(shown["opacities"], each[3], rtol=1e-4)
    assert min(counts.values()) > 3, counts


def test_packed_meta_lists_what_is_drawn():
    given = splats(60)
    given["means"] *= 2
    batches = {name: np.stack([each, each[::-1]]) for name, each in given.items()}
    cameras = {**CAMERAS, "viewmats": np.stack([CAMERAS["viewmats"]] * 2), "Ks": np.stack([CAMERAS["Ks"]] * 2)}
    _, _, whole = roofgs.rasterization(**batches, **cameras, packed=False)
    _, _, packed = roofgs.rasterization(**batches, **cameras)
    b, c, i = ids = (packed["batch_ids"], packed["camera_ids"], packed["gaussian_ids"])
    assert all(each.dtype == np.int64 for each in ids) and 0 < len(i) < 2 * 2 * 60
    assert sorted(zip(*ids)) == list(zip(*ids)) and len(i) == (whole["radii"] > 0).all(axis=-1).sum()
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        assert np.array_equal(packed[name], whole[name][b, c, i])
    assert np.array_equal(whole["conics"][1], whole["conics"][0][:, ::-1])


def test_meta_without_gaussians_or_cameras():
    given = splats()
    for n, cameras in ((0, 2), (12, 0)):
        _, _, meta = roofgs.rasterization(**{name: each[:n] for name, each in given.items()}, viewmats=CAMERAS["viewmats"][:cameras],
                                          Ks=CAMERAS["Ks"][:cameras], width=W, height=H, packed=False)
        assert meta["conics"].shape == (cameras, n, 3) and meta["radii"].shape == (cameras, n, 2)


def test_meta_is_of_what_was_drawn():
    given = {name: np.ascontiguousarray(each, np.float32) for name, each in splats().items()}
    _, _, before = roofgs.rasterization(**given, **CAMERAS)
    _, _, after = roofgs.rasterization(**given, **CAMERAS)
    assert before["depths"].max() > 1
    for each in given.values():
        each[:] = 1
    assert np.array_equal(before["depths"], after["depths"]) and np.array_equal(before["opacities"], after["opacities"])


def test_meta_is_a_mapping():
    _, _, meta = roofgs.rasterization(**splats(), **CAMERAS)
    with pytest.raises(KeyError, match="isect_ids.*tiles and lists of them.*means2d"):
        meta["isect_ids"]
    assert meta.get("isect_ids") is None and "isect_ids" not in meta and "means2d" in meta
    meta["radii"] = "mine"
    del meta["depths"]
    assert len(meta) == len(list(meta)) == 11 and "depths" not in meta
    for copied in (meta.copy(), pickle.loads(pickle.dumps(meta))):
        assert isinstance(copied, dict) and list(copied) == list(meta) and np.array_equal(copied["conics"], meta["conics"])
    assert repr(meta).startswith("Meta(")
    assert {**meta}["conics"].shape == meta["means2d"].shape[:1] + (3,) and meta["radii"] == "mine"


def test_depth_has_no_background():
    given = {**splats(), **CAMERAS, "colors": None, "render_mode": "ED"}
    plain, _, _ = roofgs.rasterization(**given)
    behind, _, _ = roofgs.rasterization(**given, backgrounds=np.ones((len(CAMERAS["viewmats"]), 3)))
    assert np.array_equal(plain, behind)


class Tensor:
    """What of a torch.Tensor counts here, where torch is not installed."""

    __module__ = "torch"

    def __init__(self, array, requires_grad):
        self.array, self.requires_grad = array, requires_grad

    def detach(self):
        return Tensor(self.array, False)

    def cpu(self):
        return self

    def numpy(self):
        assert not self.requires_grad
        return self.array


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"])
def test_gradients_are_refused_at_once(name):
    given = {**splats(), **CAMERAS}
    given[name] = Tensor(given[name], requires_grad=True)
    with pytest.raises(NotImplementedError, match=f"{name} requires a gradient.*detach"):
        roofgs.rasterization(**given)


def test_torch_tensors():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    given = {name: torch.from_numpy(value).float() for name, value in splats().items()}
    colors, alphas, meta = roofgs.rasterization(**given, viewmats=torch.from_numpy(CAMERAS["viewmats"]),
                                                Ks=torch.from_numpy(CAMERAS["Ks"]), width=W, height=H)
    assert isinstance(colors, torch.Tensor) and colors.shape == (2, H, W, 3) and alphas.device.type == "cpu"
    assert meta["means2d"].shape == meta["radii"].shape and meta["gaussian_ids"].dtype == torch.int64
    expected_colors, _, _ = roofgs.rasterization(**splats(), **CAMERAS)
    np.testing.assert_allclose(colors.numpy(), expected_colors, atol=1e-4)
    halves, _, _ = roofgs.rasterization(**{**given, "colors": given["colors"].bfloat16()}, **CAMERAS)
    np.testing.assert_allclose(halves.numpy(), expected_colors, atol=0.02)
    given["means"].requires_grad_()
    with pytest.raises(NotImplementedError, match="gradient"):
        roofgs.rasterization(**given, **CAMERAS)
    for without in (torch.no_grad, torch.inference_mode):  # as scripts render the parameters of a trained model
        with without():
            again, _, _ = roofgs.rasterization(**given, **CAMERAS)
        assert torch.equal(again, colors) and not again.requires_grad


def test_it_is_where_gsplat_has_it():
    from roofgs.rendering import rasterization

    assert rasterization is roofgs.rasterization
