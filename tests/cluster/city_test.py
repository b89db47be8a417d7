# city_test.py - samples/cluster/city and "One scene" of docs/user/CLUSTER.md: city_test.py CASE, or --list. Programs: RGS_BIN.
# SPDX-License-Identifier: Apache-2.0
import json
import os
import re
import signal
import subprocess
import sys
import tempfile

sys.path.insert(0, os.path.dirname(__file__))
from cluster_test import BIN, ROOT, environment, go, kill_at, need, page_block, same, shell, slurm, waiting_programs
from slurm_cluster import wait_for

CITY = f"{ROOT}/samples/cluster/city"
PROFILES = f"{ROOT}/samples/cluster/scenes/profiles"
OPTIONS = "--chunk-size 32"  # as on the page: two stretches of few Gaussians
TILES = [f"tiles/{i}.ply" for i in range(4)]
CASES = {}


def case(name):
    def add(function):
        CASES[name] = function
        return function
    return add


def command(profile, *config):
    return ["snakemake", "--snakefile", f"{CITY}/Snakefile", "--profile", f"{PROFILES}/{profile}", "--config",
            "ranges=4", f"options={OPTIONS}", *config]


class Run:
    """One run of the Snakefile: exit code, output, and the jobs that it started: ["begin", "scan 0", ...]."""

    def __init__(self, folder, *config, profile="local", limit="", options=(), **variables):
        words = " ".join(f"'{word}'" for word in [*command(profile, *config), *options])
        done = subprocess.run(["bash", "-c", f"{limit}exec {words}"], cwd=folder, env=environment() | variables,
                              stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        self.code, self.text = done.returncode, done.stdout
        print(self.text)
        found = re.findall(r"^(?:rule|checkpoint) (\w+):\n((?:    .*\n)*)", self.text, re.M)
        self.jobs = sorted(f"{rule} {''.join(re.findall(r'n=([0-9]+)$', said, re.M))}".strip() for rule, said in found
                           if rule != "all")


EVERYTHING = sorted(["begin", "plan", "assemble", "build 1", "build 3"] + [f"{rule} {n}" for rule in ("scan", "place")
                                                                            for n in range(4)])


def make_tiles(folder):
    same(shell(page_block("tiles"), folder).returncode, 0)


def write_camera(folder, distance):
    with open(f"{folder}/cameras.json", "w", encoding="utf-8") as file:
        json.dump([{"id": 0, "img_name": "a", "width": 640, "height": 480, "position": [0, 0, -distance],
                    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 500, "fy": 500}], file)


def by_hand(folder, name="by_hand.rgs", *more):
    """The file that a single process writes."""
    subprocess.run([f"{BIN}/rgs-convert", "--quiet", "--overwrite", "--lod", "--merge", *OPTIONS.split(), *more, *TILES, name],
                   cwd=folder, check=True, stdin=subprocess.DEVNULL)
    with open(f"{folder}/{name}", "rb") as file:
        return file.read()


def check_city(folder, wanted):
    with open(f"{folder}/city.rgs", "rb") as file:
        assert file.read() == wanted, "bytes differ from a run by hand"


def left_over(folder):
    return [name for name in os.listdir(f"{folder}/city.work") if ".tmp-" in name]


@case("the page's local run and its rerun")
def page_local(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    done = shell(page_block("city"), folder)
    same(done.returncode, 0)
    check_city(folder, wanted)
    listed = json.loads(subprocess.run([f"{BIN}/rgs-convert", "--lod-list", "city.work"], cwd=folder, check=True,
                                       capture_output=True).stdout)
    same([part["stretches"] for part in listed["ranges"]], [0, 1, 0, 1])
    assert all(part["placed"] for part in listed["inputs"]) and all(part["built"] for part in listed["ranges"])
    run = Run(folder)
    same((run.code, run.jobs), (0, []))


@case("a run repeats only missing or changed work")
def reruns(folder):
    make_tiles(folder)

    def expect(what, jobs, *config, code=0):
        run = Run(folder, *config)
        assert (run.code, run.jobs) == (code, sorted(jobs)), f"after {what}: {run.code} {run.jobs}"

    expect("nothing", EVERYTHING)
    wanted = by_hand(folder)
    check_city(folder, wanted)
    os.remove(f"{folder}/city.rgs")
    expect("the loss of the file", ["assemble"])
    os.remove(f"{folder}/city.work/range.1")
    expect("the loss of files that are no longer needed", [])
    os.remove(f"{folder}/city.rgs")
    expect("the loss of both", ["build 1", "assemble"])
    check_city(folder, wanted)
    os.utime(f"{folder}/tiles/3.ply")
    expect("a touched tile", EVERYTHING)
    check_city(folder, wanted)
    os.remove(f"{folder}/tiles/3.ply")
    subprocess.run([f"{BIN}/rgs-make-scene", "--quiet", "--seed", "9", "--gaussians", "80k", "--degree", "1", "tiles/3.ply"],
                   cwd=folder, check=True)
    expect("a changed tile", EVERYTHING)
    wanted = by_hand(folder)
    check_city(folder, wanted)
    expect("another profile and memory", EVERYTHING, f"options={OPTIONS} --profile archive:small", "memory=1 GiB")
    check_city(folder, by_hand(folder, "archive.rgs", "--profile", "archive:small"))
    expect("more memory for the last job", ["assemble"], f"options={OPTIONS} --profile archive:small", "memory=1 GiB",
           "assemble_memory=2GiB")
    expect("the first again", EVERYTHING)
    check_city(folder, wanted)
    cameras = f"options={OPTIONS} --cameras cameras.json"
    write_camera(folder, 4)
    expect("cameras", EVERYTHING, cameras)
    expect("nothing", [], cameras)
    write_camera(folder, 9)
    expect("other cameras of the same name", EVERYTHING, cameras)
    check_city(folder, by_hand(folder, "cameras.rgs", "--cameras", "cameras.json"))


@case("another version of RoofGS repeats everything")
def another_version(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    same((Run(folder).code, os.path.exists(f"{folder}/city.rgs")), (0, True))
    # The other version's files. Snakemake sees that the program changed.
    for name in ("plan", "scan.1", "rows.2", "range.3"):
        with open(f"{folder}/city.work/{name}", "wb") as file:
            file.write(b"of another version")
    os.makedirs(f"{folder}/other")
    with open(f"{folder}/other/rgs-convert", "w", encoding="utf-8") as file:
        file.write(f'#!/bin/sh\n[ "$1" != --version ] || {{ echo rgs-convert 9; exit; }}\nexec {BIN}/rgs-convert "$@"\n')
    os.chmod(f"{folder}/other/rgs-convert", 0o755)
    run = Run(folder, PATH=f"{folder}/other:{BIN}:{os.environ['PATH']}")
    same((run.code, run.jobs), (0, EVERYTHING))
    check_city(folder, wanted)


@case("jobs request time for all tiles, and memory in any notation")
def resources(folder):
    os.makedirs(f"{folder}/tiles")
    for i in range(50):
        with open(f"{folder}/tiles/{i}.ply", "wb") as file:
            os.truncate(file.fileno(), 800_000 * 248)
    text = Run(folder, "memory=1 GiB", options=["--dry-run"]).text
    found = {rule: (int(mb), int(minutes)) for rule, mb, minutes in re.findall(
        r"(?:rule|checkpoint) (\w+):\n(?:    .*\n)*?    resources: .*mem_mb=(\d+).*runtime=(\d+)", text)}
    # Of 40 million, and four times the largest other stretch; rows to place and build are unknown before the plan.
    same(found, {"begin": (1488, 10), "scan": (1488, 11), "plan": (1488, 10), "assemble": (1488, 77)})


@case("a full disk and a missing tile stop no other work, and the next run does the rest")
def faults(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    run = Run(folder, limit="ulimit -f 5000; ")  # KiB per file: less than a tile's rows
    same(run.code, 1)
    assert not any(job.startswith("build") for job in run.jobs), run.jobs
    same([name for name in sorted(os.listdir(f"{folder}/city.work")) if name.startswith(("rows", "range"))], [])
    same(left_over(folder), [])
    assert os.path.exists(f"{folder}/city.work/plan") and "File too large" in run.text, "the reason is missing"

    # The wrapper loses a tile while others are placed.
    os.makedirs(f"{folder}/losing")
    with open(f"{folder}/losing/rgs-convert", "w", encoding="utf-8") as file:
        file.write(f'#!/bin/sh\ncase "$*" in *"--lod-input 2 "*) mv "{folder}/tiles/2.ply" "{folder}/lost" ;; esac\n'
                   f'exec {BIN}/rgs-convert "$@"\n')
    os.chmod(f"{folder}/losing/rgs-convert", 0o755)
    run = Run(folder, PATH=f"{folder}/losing:{BIN}:{os.environ['PATH']}")
    same((run.code, run.jobs), (1, [f"place {n}" for n in range(4)]))
    assert "tiles/2.ply" in run.text
    os.rename(f"{folder}/lost", f"{folder}/tiles/2.ply")
    run = Run(folder)
    same((run.code, run.jobs), (0, sorted(["place 2", "build 1", "build 3", "assemble"])))
    check_city(folder, wanted)


@case("killed in any step, it ends with the same bytes")
def killed(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    for stage in ("scan", "place", "build", "write"):
        for units in (0, 1):
            kill_at(stage, units, command("local"), folder)
            subprocess.run([*command("local"), "--unlock"], cwd=folder, env=environment(), check=True, capture_output=True)
    print(f"left by killed programs: {left_over(folder)}")
    same(Run(folder).code, 0)
    check_city(folder, wanted)
    same(left_over(folder), [])
    # Each step leaves partial files when it is killed at the worst moment.
    os.utime(f"{folder}/tiles/0.ply")
    os.remove(f"{folder}/city.rgs")
    for name in ("job", "scan.0", "plan", "rows.3", "range.1"):
        with open(f"{folder}/city.work/{name}.tmp-aB3xyz", "wb") as file:
            file.write(b"half")
    same(Run(folder).jobs, EVERYTHING)
    check_city(folder, wanted)
    same(left_over(folder), [])
    same(Run(folder).jobs, [])


@case("invalid configurations are refused before anything runs")
def refusals(folder):
    make_tiles(folder)

    def refused(words, *config):
        run = Run(folder, *config)
        assert run.code == 1 and words in run.text and not run.jobs, f"{words}: {run.code}"
        assert "Traceback" not in run.text

    refused("there is no 'tile'", "tile=tiles")
    refused("config: tiles: 'nowhere' is no folder; pass --config tiles=FOLDER", "tiles=nowhere")
    refused("config: work: the folder of the tiles", "work=tiles")
    refused("config: options: No closing quotation", 'options=--cameras "a')
    refused("ranges is a number", "ranges=0")
    refused("memory is a size", "memory=much")
    refused("would be a tile", "out=tiles/city.rgs")
    os.symlink("nowhere.ply", f"{folder}/tiles/link.ply")
    refused("a link to nowhere")
    assert not os.path.exists(f"{folder}/city.work")
    # An option that the program rejects fails the first job with the program's message.
    os.remove(f"{folder}/tiles/link.ply")
    run = Run(folder, "options=--keep-order")
    same((run.code, run.jobs), (1, ["begin"]))
    assert "--keep-order requires one process" in run.text


@case("the page's GNU parallel, and the steps of a Slurm array by hand")
def page_parallel(folder):
    need("parallel")
    make_tiles(folder)
    wanted = by_hand(folder)
    same(shell(page_block("city-parallel"), folder).returncode, 0)
    check_city(folder, wanted)
    placed = os.path.join(folder, "work", "rows.0")
    before = os.stat(placed).st_mtime_ns
    os.remove(f"{folder}/city.rgs")
    same(shell(page_block("city-parallel"), folder).returncode, 0)
    check_city(folder, wanted)
    same(os.stat(placed).st_mtime_ns, before)


@case("the page's run on Slurm")
def page_slurm(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    with slurm(folder) as cluster:
        done = shell(page_block("city-slurm"), folder, SLURM_CONF=cluster.environment["SLURM_CONF"])
        same(done.returncode, 0)
        check_city(folder, wanted)
        jobs = cluster.run("scontrol", "show", "job", "-o").stdout.splitlines()
        same(len(jobs), len(EVERYTHING))
        same({re.search(r"JobState=(\w+)", job)[1] for job in jobs}, {"COMPLETED"})
        assert {re.search(r" NodeList=(\w+)", job)[1] for job in jobs} <= {"n1", "n2"}


@case("a node of Slurm is taken down in the middle")
def node_down(folder):
    make_tiles(folder)
    wanted = by_hand(folder)
    with slurm(folder) as cluster:
        run = subprocess.Popen(command("slurm"), cwd=folder, start_new_session=True, stdin=subprocess.DEVNULL,
                               env=environment(SLURM_CONF=cluster.environment["SLURM_CONF"]) |
                               {"PATH": waiting_programs(folder, "--lod-build")})
        try:
            wait_for(lambda: os.path.exists(f"{folder}/at_work.n2"))
            cluster.run("scontrol", "update", "NodeName=n2", "State=DOWN", "Reason=test")
            go(folder)
            same(run.wait(), 0)
        finally:
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGKILL)
            run.wait()
        assert re.search(r"Restarts=[1-9]", cluster.run("scontrol", "show", "job", "-o").stdout), "no job was queued again"
        check_city(folder, wanted)


def main():
    if sys.argv[1:] == ["--list"]:
        print("\n".join(CASES))
        return
    for name in ("rgs-convert", "rgs-make-scene"):
        assert os.access(f"{BIN}/{name}", os.X_OK), f"{BIN}/{name} is missing: build it, or set RGS_BIN"
    need("snakemake")
    with tempfile.TemporaryDirectory(prefix="rgs-city-") as folder:
        os.chdir(folder)
        CASES[sys.argv[1]](folder)


if __name__ == "__main__":
    main()
