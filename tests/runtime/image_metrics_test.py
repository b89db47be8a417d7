#!/usr/bin/python3
# image_metrics_test.py - the library's measures of pictures against numpy, and against scikit-image if installed.
# SPDX-License-Identifier: Apache-2.0
"""usage: image_metrics_test.py rgs_dump_image_metrics

numpy evaluates the definition: a two-dimensional window, every pixel's 11x11 neighbourhood in a zero-padded picture.
FLIP likewise: two-dimensional filters over a picture whose edge pixels repeat (Andersson et al. 2020).
MS-SSIM and GMSD by the formulas of Wang et al. 2003 and Xue et al. 2014.
scikit-image mirrors at the edges, so that it gets pictures with a border of zeros and its map is cut back to the picture.
"""
import math
import pathlib
import subprocess
import sys
import tempfile

from skip import skip_without_tool

try:
    import numpy as np
except ImportError:
    skip_without_tool("numpy is missing (Debian: python3-numpy)")
try:
    from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity
except ImportError:
    structural_similarity = None


def ssim_maps(a: np.ndarray, b: np.ndarray, pad: int):
    axis = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
    window = np.outer(axis, axis)
    window /= window.sum()

    def local_mean(x: np.ndarray) -> np.ndarray:
        padded = np.pad(x, ((pad, pad), (pad, pad), (0, 0)))
        patches = np.lib.stride_tricks.sliding_window_view(padded, (11, 11), axis=(0, 1))
        return np.einsum("yxcij,ij->yxc", patches, window)

    mu_a, mu_b = local_mean(a), local_mean(b)
    var_a, var_b = local_mean(a * a) - mu_a**2, local_mean(b * b) - mu_b**2
    covariance = local_mean(a * b) - mu_a * mu_b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mu_a * mu_b + c1) / (mu_a**2 + mu_b**2 + c1), (2 * covariance + c2) / (var_a + var_b + c2)


def ssim_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    luminance, structure = ssim_maps(a, b, 5)
    return float(np.mean(luminance * structure))


def halved(x: np.ndarray) -> np.ndarray:
    x = np.pad(x, ((0, x.shape[0] % 2), (0, x.shape[1] % 2), (0, 0)), mode="edge")
    return x.reshape(x.shape[0] // 2, 2, x.shape[1] // 2, 2, -1).mean(axis=(1, 3))


def ms_ssim_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    weights, means = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333], []
    while len(means) < 5 and min(a.shape[:2]) >= 11:
        luminance, structure = ssim_maps(a, b, 0)
        whole = (luminance * structure).mean(axis=(0, 1))
        means.append(structure.mean(axis=(0, 1)))
        a, b = halved(a), halved(b)
    means[-1] = whole
    weights = np.array(weights[:len(means)]) / sum(weights[:len(means)])
    return float(np.mean(np.prod(np.maximum(means, 0) ** weights[:, None], axis=0)))


def gmsd_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    def gradient(x: np.ndarray) -> np.ndarray:
        x = halved(255 * (x if x.shape[2] == 1 else x @ [[0.299], [0.587], [0.114]]))[..., 0]
        patches = np.lib.stride_tricks.sliding_window_view(np.pad(x, 1), (3, 3))
        prewitt = np.array([[1, 0, -1]] * 3) / 3
        return np.sqrt(np.einsum("yxij,ij->yx", patches, prewitt) ** 2 + np.einsum("yxij,ji->yx", patches, prewitt) ** 2)

    x, y = gradient(a), gradient(b)
    return float(np.std((2 * x * y + 170) / (x * x + y * y + 170)))


def ssim_by_skimage(a: np.ndarray, b: np.ndarray) -> float:
    border = ((11, 11), (11, 11), (0, 0))
    _, full = structural_similarity(np.pad(a, border), np.pad(b, border), gaussian_weights=True, sigma=1.5,
                                    use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True)
    return float(full[11:-11, 11:-11].mean())


def flip_by_definition(a: np.ndarray, b: np.ndarray, ppd: float = 67.02) -> float:
    to_xyz = np.array([[10135552, 8788810, 4435075], [2 * 2613072, 2 * 8788810, 2 * 887015],
                       [1425312 / 3, 8788810 / 3, 70074185 / 3]]) / 24577794
    white = to_xyz.sum(axis=1)

    def filtered(x: np.ndarray, window: np.ndarray) -> np.ndarray:
        r = window.shape[0] // 2
        patches = np.lib.stride_tricks.sliding_window_view(np.pad(x, r, mode="edge"), window.shape)
        return np.einsum("yxij,ij->yx", patches, window)

    def hunt_lab(linear: np.ndarray) -> np.ndarray:
        t = linear @ to_xyz.T / white
        f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29)
        x, y, z = f[..., 0], f[..., 1], f[..., 2]
        l = 116 * y - 16
        return np.stack([l, l / 100 * 500 * (x - y), l / 100 * 200 * (y - z)], axis=-1)

    def hyab(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        d = x - y
        return np.abs(d[..., 0]) + np.sqrt(d[..., 1] ** 2 + d[..., 2] ** 2)

    r = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * ppd)
    grid = np.arange(-r, r + 1) / ppd
    squares = grid[:, None] ** 2 + grid[None, :] ** 2
    csf = []
    for terms in ([(1, 0.0047)], [(1, 0.0053)], [(34.1, 0.04), (13.5, 0.025)]):
        window = sum(m * math.sqrt(math.pi / n) * np.exp(-math.pi**2 * squares / n) for m, n in terms)
        csf.append(window / window.sum())
    sd = 0.5 * 0.082 * ppd
    r = math.ceil(3 * sd)
    x = np.arange(-r, r + 1)[None, :] + np.zeros((2 * r + 1, 1))
    bell = np.exp(-(x**2 + x.T**2) / (2 * sd**2))
    detectors = []
    for window in (-x * bell, (x**2 / sd**2 - 1) * bell):
        detectors.append(np.where(window > 0, window / window[window > 0].sum(), window / -window[window < 0].sum()))

    def prepared(srgb: np.ndarray):
        v = np.clip(srgb, 0, 1)
        xyz = np.where(v > 0.04045, ((v + 0.055) / 1.055) ** 2.4, v / 12.92) @ to_xyz.T / white
        y, cx, cz = 116 * xyz[..., 1] - 16, 500 * (xyz[..., 0] - xyz[..., 1]), 200 * (xyz[..., 1] - xyz[..., 2])
        features = [np.hypot(filtered((y + 16) / 116, d), filtered((y + 16) / 116, d.T)) for d in detectors]
        y, cx, cz = (filtered(plane, window) for plane, window in zip((y, cx, cz), csf))
        ny = (y + 16) / 116
        linear = np.stack([ny + cx / 500, ny, ny - cz / 200], axis=-1) * white @ np.linalg.inv(to_xyz).T
        return hunt_lab(np.clip(linear, 0, 1)), features

    (lab_a, features_a), (lab_b, features_b) = prepared(a), prepared(b)
    largest = hyab(hunt_lab(np.array([0.0, 1, 0])), hunt_lab(np.array([0.0, 0, 1]))) ** 0.7
    colour = hyab(lab_a, lab_b) ** 0.7
    knee = 0.4 * largest
    colour = np.where(colour < knee, 0.95 * colour / knee, 0.95 + 0.05 * (colour - knee) / (largest - knee))
    feature = np.maximum(*(np.abs(f - g) for f, g in zip(features_a, features_b)))
    return float(np.mean(colour ** (1 - np.sqrt(feature / math.sqrt(2)))))


def pictures():
    """Fixed pairs: noise, a gradient against its 8-bit rounding, flat pictures, slivers, a single pixel."""
    random = np.random.default_rng(20)
    for height, width, channels in ((48, 64, 3), (31, 7, 3), (1, 40, 3), (3, 2, 1), (1, 1, 3)):
        a = random.uniform(-0.1, 1.1, (height, width, channels))
        yield a, a + random.normal(0, 0.03, a.shape)
    y, x = np.mgrid[0:90, 0:120]
    gradient = np.stack([x / 119, y / 89, 0.5 + 0.5 * np.sin(x * y / 300)], axis=2)
    yield gradient, np.round(gradient * 255) / 255
    yield gradient, np.roll(gradient, 1, axis=1)
    yield np.full((20, 30, 3), 0.2), np.full((20, 30, 3), 0.8)
    yield gradient, gradient
    y, x = np.mgrid[0:177, 0:203]
    waves = np.stack([np.sin(x / 5) * np.cos(y / 9), np.sin(x * y / 900), np.cos((x + y) / 3)], axis=2) / 2 + 0.5
    yield waves, waves * 0.9 + random.normal(0, 0.1, waves.shape)
    yield waves, 1 - waves


def main() -> None:
    program = sys.argv[1]
    worst = {"mse": 0.0, "psnr": 0.0, "ssim": 0.0, "flip": 0.0, "ms_ssim": 0.0, "gmsd": 0.0}
    count = 0
    with tempfile.TemporaryDirectory(prefix="rgs-test-") as name:
        folder = pathlib.Path(name)
        for a, b in pictures():
            a, b = a.astype(np.float32), b.astype(np.float32)
            a.tofile(folder / "a.raw")
            b.tofile(folder / "b.raw")
            height, width, channels = a.shape
            text = subprocess.run([program, str(width), str(height), str(channels), folder / "a.raw", folder / "b.raw"],
                                  check=True, capture_output=True, text=True).stdout.split()
            mse, psnr, largest, index, ssim, flip, ms_ssim, gmsd = (float(t) for t in text)
            a, b = a.astype(np.float64), b.astype(np.float64)
            expected = {"mse": float(np.mean((a - b) ** 2)), "ssim": ssim_by_definition(a, b)}
            expected["psnr"] = math.inf if expected["mse"] == 0 else 10 * math.log10(1 / expected["mse"])
            if channels == 3:
                expected["flip"] = flip_by_definition(a, b)
            if min(width, height) >= 11:
                expected["ms_ssim"] = ms_ssim_by_definition(a, b)
            expected["gmsd"] = gmsd_by_definition(a, b)
            references = [expected]
            if structural_similarity is not None:
                references.append({"mse": float(mean_squared_error(a, b)), "ssim": ssim_by_skimage(a, b),
                                   "psnr": math.inf if expected["mse"] == 0
                                   else float(peak_signal_noise_ratio(a, b, data_range=1.0))})
            found = {"mse": mse, "psnr": psnr, "ssim": ssim, "flip": flip, "ms_ssim": ms_ssim, "gmsd": gmsd}
            for reference in references:
                for key, value in reference.items():
                    if found[key] == value:
                        continue
                    difference = abs(found[key] - value)
                    bound = (1e-7 if key in ("flip", "ms_ssim", "gmsd") else 1e-9) * max(1, abs(value))
                    assert difference <= bound, (a.shape, key, found[key], value)
                    worst[key] = max(worst[key], difference)
            differences = np.abs(a.astype(np.float32) - b.astype(np.float32)).ravel()
            assert int(index) == int(np.argmax(differences)), (a.shape, index)
            assert np.float32(largest) == differences.max(), (a.shape, largest)
            count += 1
    peer = "numpy alone; python3-skimage is not installed" if structural_similarity is None else "numpy and scikit-image"
    print(f"{count} pairs agree with {peer}; largest differences {worst}")


if __name__ == "__main__":
    main()
