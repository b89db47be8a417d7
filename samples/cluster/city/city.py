# city.py - the tiles of a city, and what a job for one of them needs.
# SPDX-License-Identifier: Apache-2.0
import hashlib
import math
import os
import re
import shlex
import sys

import yaml

sys.path.insert(0, os.path.join(os.path.dirname(os.path.realpath(__file__)), "../scenes"))
from scene_folder import ConfigError, SceneFolder, version


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
    """As the programs' options read sizes."""
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*(?:([kmgtpe])(i?))?b?\s*", text.lower())
    if not found:
        raise ConfigError(f"config: memory is a size such as 2GiB, not {text!r}")
    return int(float(found[1]) * (1024 if found[3] else 1000) ** " kmgtpe".index(found[2] or " "))


COLMAP = [os.path.join(folder, name) for folder in ("", "sparse/0", "sparse")
          for name in ("cameras.bin", "images.bin", "cameras.txt", "images.txt")]


def files_named(options):
    """Files that the words of a command line name: cameras, those of a COLMAP model by its folder."""
    try:
        words = shlex.split(options)
    except ValueError as problem:
        raise ConfigError(f"config: options: {problem}: {options!r}") from problem
    for word in words:
        path = word.split("=", 1)[1] if word.startswith("--") and "=" in word else word
        yield from filter(os.path.isfile, [path, *(os.path.join(path, name) for name in COLMAP)])


def stamp_of(path):
    """Changes when a file is replaced by another one, by an older one too."""
    stat = os.stat(path)
    return f"{path} {stat.st_size} {stat.st_mtime_ns}"


class City:
    def __init__(self, config, defaults_path):
        check_config(config, defaults_path)
        self.out, self.work = os.path.normpath(config["out"]), os.path.normpath(config["work"])
        if not os.path.isdir(config["tiles"]):
            raise ConfigError(f"config: tiles: {config['tiles']!r} is no folder; pass --config tiles=FOLDER")
        if os.path.realpath(config["tiles"]) == os.path.realpath(self.work):
            raise ConfigError("config: work: the folder of the tiles cannot be that of the work; pass --config work=ANOTHER")
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
        self.assemble_memory = config["assemble_memory"] or config["memory"]
        self._mb, self._assemble_mb = (200 + int(1.2 * bytes_of(memory) / 1e6) + self._tile_mb
                                       for memory in (config["memory"], self.assemble_memory))
        self._millions = [self._folder.millions(name) for name in self._names]
        self._per_range = sum(self._millions) / config["ranges"] + 1.6  # one may have a stretch more than others
        # Whatever makes another job: a changed value makes all of it again.
        said = [version("rgs-convert"), config["ranges"], config["options"], config["memory"]]
        said += [f"{path} {os.path.getsize(path)}" for path in self.tiles]
        said += [stamp_of(path) for path in files_named(config["options"])]
        self.key = hashlib.sha256("\n".join(map(str, said)).encode()).hexdigest()

    def write_list(self, path):
        with open(path, "w", encoding="utf-8") as file:
            file.writelines(tile + "\n" for tile in self.tiles)

    def megabytes(self, wildcards, attempt):
        return attempt * self._mb

    def assemble_megabytes(self, wildcards, attempt):
        return attempt * self._assemble_mb

    def minutes(self, base, per_million, tile=None):
        """For a job on a tile, or else on a range: without other jobs on its cores."""
        millions = self._millions[tile] if tile is not None else self._per_range
        return base + math.ceil(per_million * millions)

    def stamp(self, tile):
        """Changes when a file is replaced by another one, by an older one too."""
        return self._folder.stamp(self._names[tile])
