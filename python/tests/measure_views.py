#!/usr/bin/python3
"""How fast many small views are drawn: one call each, and in batches; and what a call from Python costs beside C++.

    python3 measure_views.py scene.rgs [--device cuda] [--views 10000] [--batch 100] [--size 256]

Calls alternate, so that both meet the same machine; the smallest time of each counts. SPDX-License-Identifier: Apache-2.0
"""
import argparse
import json
import time

import numpy as np

import roofgs


def seconds(call):
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def throughput(renderer, scene, views, size, batch, empty=lambda shape: np.empty(shape, np.uint8)):
    """Views a second, one by one and in batches, into memory that is there."""
    single, several = empty((size, size, 3)), empty((batch, size, size, 3))
    best = [np.inf, np.inf]
    for first in range(0, len(views) - batch + 1, batch):
        part = views[first:first + batch]
        best[0] = min(best[0], seconds(lambda: [renderer.render(scene, view, out=single) for view in part]))
        best[1] = min(best[1], seconds(lambda: renderer.render(scene, part, out=several)))
    return batch / best[0], batch / best[1]


def overhead(renderer, n=2000):
    """Microseconds of a call beyond what the library measures of its frame: of one Gaussian in 16x16 pixels."""
    scene = roofgs.Scene([[0, 0, 2]], [[1, 0, 0, 0]], [[0.1] * 3], [0.5], np.zeros((1, 1, 3)))
    view, out, beyond = roofgs.Camera(16, 16, 20), np.empty((16, 16, 3), np.float32), []
    for _ in range(n):
        took = seconds(lambda: renderer.render(scene, view, out=out))
        beyond.append(took - renderer.stats[0]["total_ms"] * 1e-3)
    return 1e6 * float(np.median(beyond))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--views", type=int, default=10_000)
    parser.add_argument("--batch", type=int, default=100)
    parser.add_argument("--size", type=int, default=256)
    a = parser.parse_args()
    scene, renderer = roofgs.load(a.scene), roofgs.Renderer(device=a.device)
    views = roofgs.cameras.orbit(scene, a.views, width=a.size, height=a.size)
    renderer.render(scene, views[0])
    one_by_one, in_batches = throughput(renderer, scene, views, a.size, min(a.batch, a.views))
    print(json.dumps({"device": renderer.name, "gaussians": len(scene), "size": a.size, "views": a.views, "batch": a.batch,
                      "one_by_one_per_second": round(one_by_one, 1), "in_batches_per_second": round(in_batches, 1),
                      "overhead_us": round(overhead(renderer), 1)}, indent=2))


if __name__ == "__main__":
    main()
