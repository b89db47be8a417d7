#!/usr/bin/python3
# image_metrics_test.py - the library's PSNR and SSIM against numpy, and against scikit-image if installed.
# SPDX-License-Identifier: Apache-2.0
"""usage: image_metrics_test.py rgs_dump_image_metrics

numpy evaluates the definition: a two-dimensional window, every pixel's 11x11 neighbourhood in a zero-padded picture.
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


def ssim_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    axis = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
    window = np.outer(axis, axis)
    window /= window.sum()

    def local_mean(x: np.ndarray) -> np.ndarray:
        padded = np.pad(x, ((5, 5), (5, 5), (0, 0)))
        patches = np.lib.stride_tricks.sliding_window_view(padded, (11, 11), axis=(0, 1))
        return np.einsum("yxcij,ij->yxc", patches, window)

    mu_a, mu_b = local_mean(a), local_mean(b)
    var_a, var_b = local_mean(a * a) - mu_a**2, local_mean(b * b) - mu_b**2
    covariance = local_mean(a * b) - mu_a * mu_b
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * mu_a * mu_b + c1) * (2 * covariance + c2)
                         / ((mu_a**2 + mu_b**2 + c1) * (var_a + var_b + c2))))


def ssim_by_skimage(a: np.ndarray, b: np.ndarray) -> float:
    border = ((11, 11), (11, 11), (0, 0))
    _, full = structural_similarity(np.pad(a, border), np.pad(b, border), gaussian_weights=True, sigma=1.5,
                                    use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True)
    return float(full[11:-11, 11:-11].mean())


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


def main() -> None:
    program = sys.argv[1]
    worst = {"mse": 0.0, "psnr": 0.0, "ssim": 0.0}
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
            mse, psnr, largest, index, ssim = (float(t) for t in text)
            a, b = a.astype(np.float64), b.astype(np.float64)
            expected = {"mse": float(np.mean((a - b) ** 2)), "ssim": ssim_by_definition(a, b)}
            expected["psnr"] = math.inf if expected["mse"] == 0 else 10 * math.log10(1 / expected["mse"])
            references = [expected]
            if structural_similarity is not None:
                references.append({"mse": float(mean_squared_error(a, b)), "ssim": ssim_by_skimage(a, b),
                                   "psnr": math.inf if expected["mse"] == 0
                                   else float(peak_signal_noise_ratio(a, b, data_range=1.0))})
            found = {"mse": mse, "psnr": psnr, "ssim": ssim}
            for reference in references:
                for key, value in reference.items():
                    if found[key] == value:
                        continue
                    difference = abs(found[key] - value)
                    assert difference <= 1e-9 * max(1, abs(value)), (a.shape, key, found[key], value)
                    worst[key] = max(worst[key], difference)
            differences = np.abs(a.astype(np.float32) - b.astype(np.float32)).ravel()
            assert int(index) == int(np.argmax(differences)), (a.shape, index)
            assert np.float32(largest) == differences.max(), (a.shape, largest)
            count += 1
    peer = "numpy alone; python3-skimage is not installed" if structural_similarity is None else "numpy and scikit-image"
    print(f"{count} pairs agree with {peer}; largest differences {worst}")


if __name__ == "__main__":
    main()
