"""A torch Dataset of rendered views: python3 rendered_views.py scene.rgs cameras.json [WORKERS]

Each worker of a DataLoader opens the scene itself, when it draws its first view: RoofGS has threads, which a forked process does
not inherit. The process that makes the data set must not load scenes before its workers have begun, or start them by
"spawn". SPDX-License-Identifier: Apache-2.0
"""
import os
import sys

import torch
from torch.utils.data import DataLoader, Dataset

import roofgs


class RenderedViews(Dataset):
    """Item i is the picture of camera i, float32 [3, height, width], and its index."""

    def __init__(self, scene, cameras, threads=1, **options):
        self.scene_path, self.cameras = os.fspath(scene), list(cameras)
        self.threads, self.options = threads, options
        self._opened = None  # by this process: (its id, scene, renderer)

    def __len__(self):
        return len(self.cameras)

    def __getitem__(self, i):
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), roofgs.load(self.scene_path), roofgs.Renderer(device="cpu", threads=self.threads)
        _, scene, renderer = self._opened
        image = renderer.render(scene, self.cameras[i], **self.options)
        return torch.from_numpy(image).permute(2, 0, 1), i

    def __getstate__(self):  # for workers that are spawned
        return {**self.__dict__, "_opened": None}


def main():
    scene, cameras = sys.argv[1], roofgs.cameras.load(sys.argv[2])
    workers = int(sys.argv[3]) if len(sys.argv) > 3 else 2
    views = RenderedViews(scene, [camera.resized(320, 240) for camera in cameras])
    for images, indices in DataLoader(views, batch_size=4, num_workers=workers):
        print(tuple(images.shape), indices.tolist(), f"mean {images.mean():.4f}")


if __name__ == "__main__":
    main()
