# scene_folder.py - the scenes below a folder, and what a job for one of them needs.
# SPDX-License-Identifier: Apache-2.0
import fnmatch
import os
import subprocess

import yaml

# Bytes a Gaussian of the densest files of each ending that are common: few bytes, many Gaussians. The first that fits counts.
ENDINGS = {
    ".compressed.ply": 24,
    ".ply": 248,
    ".spz": 16,
    ".splat": 32,
    ".ksplat": 24,
    ".sog": 10,
    ".glb": 60,
    ".usda": 100,
    ".usdz": 100,
    ".npz": 236,
    ".pt": 236,
    ".rgs": 9,
}
SOG_FOLDER = "meta.json"  # a SOG that is no archive: pictures beside it


class ConfigError(Exception):
    pass


def check_config(config, defaults_path):
    """Makes values texts. Refuses keys that config.yaml does not have: a mistyped one would change nothing."""
    with open(defaults_path) as file:
        known = yaml.safe_load(file)
    for key in config:
        if key not in known:
            raise ConfigError(f"config: there is no '{key}'; known are {', '.join(known)}")
    for key, value in config.items():
        if isinstance(value, (list, dict)):
            raise ConfigError(f"config: {key} is one value, not {value!r}")
        if key != "max_threads":
            config[key] = "" if value is None else str(value)  # YAML reads "2024" as a number, and "" as nothing
    if not isinstance(config["max_threads"], int) or config["max_threads"] < 1:
        raise ConfigError(f"config: max_threads is a number from 1, not {config['max_threads']!r}")


def version(program):
    """What `program --version` prints. A job of another version is another job."""
    try:
        return subprocess.run([program, "--version"], check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError) as problem:
        raise ConfigError(f"{program} does not run ({problem}): put RoofGS's programs on PATH") from problem


def stem_of(name):
    """`a/b` of a/b.ply and a/b.compressed.ply; None if the name is not that of a scene."""
    if os.path.basename(name) == SOG_FOLDER:
        return name[: -len(".json")]
    for ending in ENDINGS:
        if name.lower().endswith(ending) and len(os.path.basename(name)) > len(ending):
            return name[: -len(ending)]
    return None


class SceneFolder:
    """Scenes by name: the path below the folder without its ending."""

    def __init__(self, folder, cameras, leave_out, out):
        if not os.path.isdir(folder):
            raise ConfigError(f"config: scenes: {folder!r} is no folder; pass --config scenes=FOLDER")
        if os.path.realpath(folder) == os.path.realpath(out):
            raise ConfigError("config: out: results in the folder of scenes would be scenes; pass --config out=ANOTHER")
        if cameras and not os.path.exists(cameras):
            raise ConfigError(f"config: cameras: {cameras!r} is not there")
        self._cameras = cameras
        self._paths = {}
        self.unusable = {}  # name: why no job can be made for it
        self._walk(folder, "", [os.path.realpath(out)], leave_out.split())
        if not self._paths and not self.unusable:
            raise ConfigError(f"no scene in {folder!r}: files ending in {' '.join(ENDINGS)}")

    # Links are followed, hidden files are not scenes, nor is what a killed program left (NAME.tmp-XXXXXX): it has no ending of
    # a scene.
    def _walk(self, folder, prefix, above, leave_out):
        real = os.path.realpath(folder)
        if real in above:
            return
        try:
            names = sorted(os.listdir(folder))
        except OSError as problem:
            self.unusable[prefix.rstrip("/") or folder] = str(problem)
            return
        for entry in names:
            path, name = os.path.join(folder, entry), prefix + entry
            if entry.startswith(".") or any(fnmatch.fnmatch(name, pattern) for pattern in leave_out):
                continue
            if os.path.isdir(path):
                self._walk(path, name + "/", [*above, real], leave_out)
            elif stem_of(name) and (entry != SOG_FOLDER or os.path.exists(os.path.join(folder, "means_l.webp"))):
                self._add(path, name)

    def _add(self, path, name):
        stem = stem_of(name)
        if problem := self._problem(path, name):
            self.unusable[name.encode(errors="replace").decode()] = problem
        elif stem in self._paths:
            raise ConfigError(f"{self._paths[stem]} and {path} would have the same output: rename one")
        else:
            self._paths[stem] = path

    @staticmethod
    def _problem(path, name):
        try:
            name.encode()
        except UnicodeEncodeError:
            return "the name is not UTF-8: rename it"
        if any(c in "{}" or not c.isprintable() for c in name):
            return "Snakemake cannot handle braces and control characters in a name: rename it"
        if not os.path.isfile(path):
            return "a link to nowhere, or no regular file"
        return None

    def names(self):
        return sorted(self._paths)

    def source(self, name):
        return self._paths[name]

    def files(self, name):
        """The scene's file first; then those that it refers to."""
        path = self._paths[name]
        if os.path.basename(path) != SOG_FOLDER:
            return [path]
        folder = os.path.dirname(path)
        return [path, *sorted(os.path.join(folder, f) for f in os.listdir(folder) if f.endswith(".webp"))]

    def cameras(self, name):
        """[] or [path]."""
        if not self._cameras or not os.path.isdir(self._cameras):
            return [self._cameras] if self._cameras else []
        own = os.path.join(self._cameras, name + ".json")
        return [own] if os.path.exists(own) else []

    def stamp(self, name):
        """Changes when a file is replaced by another one, by an older one too."""
        stats = [os.stat(f) for f in self.files(name) + self.cameras(name)]
        return [f"{stat.st_size} {stat.st_mtime_ns}" for stat in stats]

    def millions(self, name):
        path = self._paths[name]
        ending = next((e for e in ENDINGS if path.lower().endswith(e)), ".sog")
        return sum(os.path.getsize(f) for f in self.files(name)) / ENDINGS[ending] / 1e6

    def threads(self, name, most):
        return max(1, min(most, 1 + int(self.millions(name) / 4)))

    def megabytes(self, name, base, per_million):
        return base + int(per_million * self.millions(name))

    def minutes(self, name, base, per_million):
        return base + int(per_million * self.millions(name))
