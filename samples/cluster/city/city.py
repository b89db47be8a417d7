# city.py - the tiles of a city, and what a job for one of them needs.
# SPDX-License-Identifier: Apache-2.0
import hashlib
import os
import re
import sys

import yaml

sys.path.insert(0, os.path.join(os.path.dirname(os.path.realpath(__file__)), "../scenes"))
from scene_folder import ConfigError, SceneFolder, version

UNITS = {"": 1, "kB": 1000, "MB": 1000**2, "GB": 1000**3, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


def check_config(config, defaults_path):
    """Makes values texts, numbers where a number is meant. Refuses keys that config.yaml does not have."""
    with open(defaults_path, encoding="utf-8") as file:
        known = yaml.safe_load(file)
    for key in config:
        if key not in known:
            raise ConfigError(f"config: there is no '{key}'; known are {', '.join(known)}")
    for key, value in config.items():
        if isinstance(known[key], int):
            if not isinstance(value, int) or value < 1:
                raise ConfigError(f"config: {key} is a number from 1, not {value!r}")
        elif isinstance(value, (list, dict)):
            raise ConfigError(f"config: {key} is one value, not {value!r}")
        else:
            config[key] = "" if value is None else str(value)


def bytes_of(text):
    found = re.fullmatch(r"(\d+) ?([kMGKi]*B?)", text)
    if not found or found[2] not in UNITS:
        raise ConfigError(f"config: memory is a size such as 2GiB, not {text!r}")
    return int(found[1]) * UNITS[found[2]]


class City:
    def __init__(self, config, defaults_path):
        check_config(config, defaults_path)
        self.out, self.work = os.path.normpath(config["out"]), os.path.normpath(config["work"])
        self._folder = SceneFolder(config["tiles"], "", config["leave_out"], self.work)
        if self._folder.unusable:
            name, why = sorted(self._folder.unusable.items())[0]
            raise ConfigError(f"config: tiles: {name}: {why}")
        tiles = os.path.realpath(config["tiles"])
        if os.path.realpath(self.out).startswith(tiles + os.sep):
            raise ConfigError("config: out: a file in the folder of tiles would be a tile; pass --config out=ANOTHER")
        self._names = self._folder.names()
        self.tiles = [self._folder.source(name) for name in self._names]
        self.threads = config["threads"]
        # Of packed formats a tile is in memory, at 300 bytes a Gaussian.
        packed = [n for n, tile in zip(self._names, self.tiles)
                  if not tile.lower().endswith(".ply") or tile.lower().endswith(".compressed.ply")]
        self._tile_mb = max([self._folder.megabytes(name, 0, 600) for name in packed], default=0)
        self._mb = 200 + int(1.2 * bytes_of(config["memory"]) / 1e6) + self._tile_mb
        self._per_range = sum(self._folder.minutes(name, 0, 1) for name in self._names) // config["ranges"] + 1
        # Whatever makes another job: a changed value makes all of it again.
        said = [version("rgs-convert"), config["ranges"], config["options"], config["memory"]]
        said += [f"{path} {os.path.getsize(path)}" for path in self.tiles]
        self.key = hashlib.sha256("\n".join(map(str, said)).encode()).hexdigest()

    def write_list(self, path):
        with open(path, "w", encoding="utf-8") as file:
            file.writelines(tile + "\n" for tile in self.tiles)

    def megabytes(self, wildcards, attempt):
        return attempt * self._mb

    def minutes(self, base, per_million, tile=None):
        """For a job on a tile, or else on a range: without other jobs on its cores."""
        millions = self._folder.minutes(self._names[tile], 0, 1) if tile is not None else self._per_range
        return base + per_million * millions

    def stamp(self, tile):
        """Changes when a file is replaced by another one, by an older one too."""
        return self._folder.stamp(self._names[tile])
