# cluster_test.py - samples/cluster and docs/user/CLUSTER.md: cluster_test.py CASE, or --list. Programs under test: RGS_BIN.
# SPDX-License-Identifier: Apache-2.0
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile

sys.path.insert(0, os.path.join(os.path.dirname(__file__), "../support"))
import slurm_cluster
from skip import skip_without_tool
from slurm_cluster import SlurmCluster, wait_for

ROOT = os.path.realpath(os.path.join(os.path.dirname(__file__), "../.."))
SCENES = f"{ROOT}/samples/cluster/scenes"
BIN = os.path.realpath(os.environ.get("RGS_BIN", f"{ROOT}/build/release/bin"))
QUICK = "audit=--views 2 --size 96x64 --no-attribution"
CASES = {}


def case(name):
    def add(function):
        CASES[name] = function
        return function
    return add


# ---- helpers

def environment(**more):
    # CI: Snakemake asks Slurm for its jobs' states every second instead of every ten.
    return dict(os.environ, PATH=f"{BIN}:{os.environ['PATH']}", ROOFGS=ROOT, CI="true", **more)


def page_block(name):
    """The commands below <!-- name --> of docs/user/CLUSTER.md."""
    with open(f"{ROOT}/docs/user/CLUSTER.md", encoding="utf-8") as page:
        found = re.search(rf"<!-- {name} -->\n((?:    .*\n|\n)+)", page.read())
    assert found, f"docs/user/CLUSTER.md has no commands '{name}'"
    return found[1]


def shell(commands, folder, **variables):
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", commands], cwd=folder, env=environment(**variables),
                          stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    print(done.stdout)
    return done


def command(profile, *config):
    return ["snakemake", "--snakefile", f"{SCENES}/Snakefile", "--profile", f"{SCENES}/profiles/{profile}", "--config",
            *config]


class Run:
    """One run of the Snakefile: exit code, output, and the jobs that it started: [("convert", "a/b"), ...]."""

    def __init__(self, folder, *config, profile="local", options=(), **variables):
        done = subprocess.run([*command(profile, QUICK, *config), *options], cwd=folder, env=environment(**variables),
                              stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                              check=False)
        self.code, self.text = done.returncode, done.stdout
        print(self.text)
        self.jobs = sorted(re.findall(r"^rule (convert|audit):\n(?:    .*\n)*?    wildcards: scene=(.*)$", self.text, re.M))


def make_scene(path, seed=1, gaussians="500", cameras=None):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    program("rgs-make-scene", "--quiet", "--overwrite", "--no-sync", "--seed", str(seed), "--gaussians", gaussians, path,
            *(["--cameras", cameras] if cameras else []))


def program(*arguments):
    subprocess.run([f"{BIN}/{arguments[0]}", *arguments[1:]], check=True, stdin=subprocess.DEVNULL)


def rows(folder, out="results"):
    with open(f"{folder}/{out}/index.json", encoding="utf-8") as file:
        return {row["scene"]: row for row in json.load(file)["scenes"]}


def results(folder, out="results"):
    return {name: row["result"] for name, row in rows(folder, out).items()}


def audit_of(folder, name, out="results"):
    with open(f"{folder}/{out}/audits/{name}.json", encoding="utf-8") as file:
        return json.load(file)


def files_below(folder):
    """Without hidden files, where programs keep notes."""
    return sorted(os.path.relpath(os.path.join(at, name), folder) for at, _, names in os.walk(folder) for name in names
                  if not name.startswith("."))


def same(actual, wanted):
    assert actual == wanted, f"{actual}\n  is not\n{wanted}"


def same_as_by_hand(folder, assets, sources):
    """The assets are exactly those of `sources`, byte for byte as one rgs-convert writes them."""
    same(files_below(f"{folder}/{assets}"), sorted(stem + ".rgs" for stem in sources))
    with tempfile.TemporaryDirectory() as other:
        for stem, source in sources.items():
            by_hand = f"{other}/by_hand.rgs"
            subprocess.run([f"{BIN}/rgs-convert", "--quiet", "--overwrite", source, by_hand], cwd=folder, check=True)
            with open(by_hand, "rb") as a, open(f"{folder}/{assets}/{stem}.rgs", "rb") as b:
                assert a.read() == b.read(), f"{stem}: bytes differ from a run by hand"


def need(*programs):
    for name in programs:
        if shutil.which(name) is None:
            skip_without_tool(f"{name} is not installed")


KILLED_WITH_ALL = """#!/usr/bin/python3
import os, signal, sys
child = os.fork()
if child == 0:
    os.environ["RGS_FAILPOINT"] = "{stage}:{units}:" + str(int(signal.SIGSTOP))
    os.execv("{program}", ["{program}", *sys.argv[1:]])
_, status = os.waitpid(child, os.WUNTRACED)
if os.WIFSTOPPED(status):
    os.kill(0, signal.SIGKILL)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def kill_at(stage, units, run, folder):
    """Starts `run`, and kills it and its programs when one of them reaches this failpoint."""
    os.makedirs(f"{folder}/killing", exist_ok=True)
    for name in ("rgs-convert", "rgs-audit"):
        with open(f"{folder}/killing/{name}", "w", encoding="utf-8") as file:
            file.write(KILLED_WITH_ALL.format(stage=stage, units=units, program=f"{BIN}/{name}"))
        os.chmod(f"{folder}/killing/{name}", 0o755)
    done = subprocess.run(run, cwd=folder, env=environment() | {"PATH": f"{folder}/killing:{BIN}:{os.environ['PATH']}"},
                          start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True, check=False)
    assert done.returncode == -signal.SIGKILL, f"{stage} {units}: {done.returncode}\n{done.stdout}"


@contextlib.contextmanager
def slurm(folder, **options):
    if os.geteuid() != 0:
        print("skipped: Slurm's daemons need root")
        sys.exit(77)
    if reason := slurm_cluster.missing():
        skip_without_tool(reason)
    with SlurmCluster(f"{folder}/slurm", **options) as cluster:
        try:
            yield cluster
        except BaseException:
            for job in cluster.run("scontrol", "show", "job", "-o", check=False).stdout.splitlines():
                print(*re.findall(r"\b(?:JobId|JobName|JobState|Restarts|RunTime|NodeList)=\S*", job))
            raise
    wait_for(lambda: not cluster.processes())


PAGE_SCENES = {"house1": "scenes/house1.ply", "house2": "scenes/house2.ply", "house3": "scenes/house3.ply",
               "house4": "scenes/house4.ply", "old/phone": "scenes/old/phone.spz", "old/served": "scenes/old/served.rgs"}


def check_page_run(folder, done):
    assert done.returncode == 1, done.returncode
    same(results(folder), {"cut_off": "convert failed"} | {name: "passed" for name in PAGE_SCENES})
    assert "byte 1000000: the file is too short" in rows(folder)["cut_off"]["error"], rows(folder)["cut_off"]
    same_as_by_hand(folder, "results/assets", PAGE_SCENES)
    same(files_below(f"{folder}/results/audits"), sorted(f"{n}.{kind}" for n in PAGE_SCENES for kind in ("html", "json")))


# ---- local

@case("the page's local run and its rerun")
def page_local(folder):
    same(shell(page_block("scenes"), folder).returncode, 0)
    check_page_run(folder, shell(page_block("local"), folder))
    for name in ("index.html", "index.json", "assets/old/phone.rgs", "audits/old/phone.html", "audits/old/phone.json",
                 "logs/convert/old/phone.log", "logs/audit/old/phone.log"):
        assert os.path.exists(f"{folder}/results/{name}"), name
    os.remove(f"{folder}/scenes/cut_off.ply")
    done = shell(page_block("local"), folder)
    same(done.returncode, 0)
    assert "rule convert" not in done.stdout and "rule audit" not in done.stdout
    same(results(folder), {name: "passed" for name in PAGE_SCENES})


@case("a run repeats only missing or changed work")
def reruns(folder):
    for seed, name in enumerate("abc"):
        make_scene(f"{folder}/scenes/{name}.ply", seed)
    both = [("audit", "b"), ("convert", "b")]
    everything = [(rule, name) for rule in ("audit", "convert") for name in "abc"]

    def expect(what, jobs, *config, code=0):
        run = Run(folder, *config)
        assert (run.code, run.jobs) == (code, jobs), f"after {what}: {run.code} {run.jobs}"

    expect("nothing", everything)
    expect("everything", [])
    make_scene(f"{folder}/scenes/b.ply", 7)
    expect("a newer scene", both)
    os.utime(f"{folder}/scenes/c.ply", (1e9, 1e9))
    expect("an older scene in its place", [("audit", "c"), ("convert", "c")])
    os.remove(f"{folder}/results/assets/b.rgs")
    expect("the loss of an asset", both)
    os.remove(f"{folder}/results/audits/b.json")
    expect("the loss of an audit", [("audit", "b")])
    os.remove(f"{folder}/results/index.html")
    expect("the loss of the index", [])
    assert os.path.exists(f"{folder}/results/index.html")
    expect("a gate", [job for job in everything if job[0] == "audit"], "fail_below=psnr=41")
    with open(f"{folder}/results/logs/audit/a.log", encoding="utf-8") as log:
        assert "as measured before" in log.read(), "a new gate draws pictures again"
    same([c["limit"] for c in audit_of(folder, "a")["gate"]["conditions"]], [41])
    expect("the same gate", [], "fail_below=psnr=41")
    expect("no gate", [job for job in everything if job[0] == "audit"], "fail_below=")
    expect("another gate", [job for job in everything if job[0] == "audit"])
    expect("another profile", everything, "convert=--profile direct")
    make_scene(f"{folder}/scenes/new/d.ply")
    expect("a new scene", [("audit", "new/d"), ("convert", "new/d")], "convert=--profile direct")
    with open(f"{folder}/scenes/bad.ply", "wb"):
        pass
    expect("a damaged scene", [("convert", "bad")], "convert=--profile direct", code=1)
    same(results(folder)["bad"], "convert failed")
    os.remove(f"{folder}/scenes/bad.ply")
    expect("its removal", [], "convert=--profile direct")
    assert "bad" not in results(folder)
    os.remove(f"{folder}/scenes/a.ply")
    expect("the loss of a scene", [], "convert=--profile direct")
    same(results(folder), {"b": "passed", "c": "passed", "new/d": "passed"})


@case("a scene that fails stops no other, and the index says why")
def failures(folder):
    names = ["a", "it's \"quoted\"", "sp ace", "$HOME", "ünï", "-dash", "deep/er/é & co", "percent%20", "#1", "*"]
    for seed, name in enumerate(names):
        make_scene(f"{folder}/scenes/{name}.ply", seed)
    with open(f"{folder}/scenes/a.ply", "rb") as whole, open(f"{folder}/scenes/0_damaged.ply", "wb") as cut:
        cut.write(whole.read()[:50000])
    for name in ("empty.ply", "empty.spz.tmp-a1B2c3", ".hidden.ply", "README.md", "cameras.json", "meta.json"):
        open(f"{folder}/scenes/{name}", "wb").close()
    os.symlink("nowhere.ply", f"{folder}/scenes/link.ply")
    os.symlink(".", f"{folder}/scenes/loop")
    make_scene(f"{folder}/elsewhere/far.ply", 77)
    os.symlink("../elsewhere", f"{folder}/scenes/linked")
    make_scene(f"{folder}/scenes/bra{{ce}}.ply")
    make_scene(f"{folder}/scenes/line\nbreak.ply")
    make_scene(f"{folder}/scenes/nan.ply")
    with open(f"{folder}/scenes/bytes\udcff.ply", "wb"):
        pass
    run = Run(folder)
    same(run.code, 1)
    wanted = {name: "passed" for name in [*names, "linked/far", "nan"]}
    wanted |= {"0_damaged": "convert failed", "empty": "convert failed", "link.ply": "not usable",
               "bra{ce}.ply": "not usable", "line\nbreak.ply": "not usable", "bytes?.ply": "not usable"}
    same(results(folder), wanted)
    assert "[truncated]" in rows(folder)["0_damaged"]["error"]
    same(files_below(f"{folder}/results/assets"), sorted(n + ".rgs" for n, result in wanted.items() if result == "passed"))
    with open(f"{folder}/results/index.html", encoding="utf-8") as file:
        page = file.read()
    assert "12 of 18 scenes pass" in page and "[truncated]" in page and "it&#x27;s &quot;quoted&quot;" in page
    for link in re.findall(r'href="([^"]*)"', page):
        target = link.replace("&amp;", "&")
        path = os.path.join(f"{folder}/results", re.sub("%(..)", lambda m: chr(int(m[1], 16)), target)
                            .encode("latin-1").decode())
        assert os.path.exists(path), link

    # A gate that nothing passes is a result: the reports stay, and nothing runs again.
    for name in ("0_damaged.ply", "empty.ply", "link.ply", "bra{ce}.ply", "line\nbreak.ply", "bytes\udcff.ply"):
        os.remove(f"{folder}/scenes/{name}")
    run = Run(folder, "fail_below=psnr=500,ratio=1")
    same((run.code, len(run.jobs)), (1, 12))
    same(set(results(folder).values()), {"gate failed"})
    condition, = rows(folder)["a"]["failed_conditions"]
    same((condition["name"], condition["limit"]), ("psnr", 500))
    assert os.path.exists(f"{folder}/results/audits/a.html") and "psnr is " in run.text and "0 of 12 scenes pass" in run.text
    run = Run(folder, "fail_below=psnr=500,ratio=1")
    same((run.code, run.jobs), (1, []))


@case("invalid configurations are refused before anything runs")
def refusals(folder):
    make_scene(f"{folder}/scenes/a.ply")

    def refused(words, *config, **variables):
        run = Run(folder, *config, **variables)
        assert run.code == 1 and words in run.text and not run.jobs, f"{words}: {run.code}"
        assert "Traceback" not in run.text

    refused("there is no 'fail_bellow'", "fail_bellow=psnr=50")
    refused("'nowhere' is no folder", "scenes=nowhere")
    refused("'nowhere.json' is not there", "cameras=nowhere.json")
    refused("max_threads is a number", "max_threads=0")
    refused("would be scenes", "out=./scenes")
    os.mkdir(f"{folder}/empty")
    refused("no scene in 'empty'", "scenes=empty")
    shutil.copy(f"{folder}/scenes/a.ply", f"{folder}/scenes/a.compressed.ply")
    refused("would have the same output")
    assert not os.path.exists(f"{folder}/results/assets")
    same(Run(folder, "leave_out=*.compressed.ply").code, 0)


@case("results may lie in the folder of scenes, and cameras are used")
def inside(folder):
    os.mkdir(f"{folder}/views")
    make_scene(f"{folder}/x/a.ply", cameras=f"{folder}/views/a.json")
    make_scene(f"{folder}/x/b.ply")
    config = ["scenes=x", "out=x/made", "cameras=views", "audit=--size 96x64 --no-attribution"]
    for _ in range(2):
        run = Run(folder, *config)
        same((run.code, sorted(results(folder, "x/made"))), (0, ["a", "b"]))
    same(run.jobs, [])
    same([audit_of(folder, name, "x/made")["rendered"]["automatic_views"] for name in "ab"], [False, True])
    os.utime(f"{folder}/views/a.json", (1e9, 1e9))
    same(Run(folder, *config).jobs, [("audit", "a"), ("convert", "a")])


@case("jobs request threads, memory and time by the size of a scene")
def resources(folder):
    make_scene(f"{folder}/scenes/small.ply")
    os.makedirs(f"{folder}/scenes/sog")
    for name in ("meta.json", "means_l.webp"):
        open(f"{folder}/scenes/sog/{name}", "wb").close()
    with open(f"{folder}/scenes/large.ply", "wb") as file:
        os.truncate(file.fileno(), 10_000_000 * 248)
    text = Run(folder, options=["--dry-run", "--cores", "16"]).text
    found = {(rule, scene): (int(threads or 1), int(mb), int(minutes)) for rule, scene, threads, mb, minutes in re.findall(
        r"rule (\w+):\n(?:    .*\n)*?    wildcards: scene=(.*)\n(?:    threads: (\d+)\n)?"
        r"    resources: .*mem_mb=(\d+).*runtime=(\d+)", text)}
    same(found[("convert", "large")], (3, 8200, 20))
    same(found[("audit", "large")], (3, 15500, 130))
    same(found[("convert", "small")], (1, 200, 10))
    same(found[("convert", "sog/meta")], (1, 200, 10))
    assert "scenes/sog/meta.json, scenes/sog/means_l.webp" in text
    same(Run(folder, "max_threads=2", options=["--dry-run", "--cores", "16"]).text.count("threads: 2\n"), 2)


@case("killed in any step, the next run finishes the work")
def killed(folder):
    sources = {}
    for seed in range(6):
        make_scene(f"{folder}/scenes/{seed}.ply", seed, "5k")
        sources[str(seed)] = f"scenes/{seed}.ply"
    for stage, units in (("scan", 0), ("encode", 1), ("commit", 0), ("reading", 0), ("rendering", 1)):
        kill_at(stage, units, command("local", QUICK), folder)
        # A lock is left behind; Snakemake names it and --unlock removes it.
        subprocess.run([*command("local", QUICK), "--unlock"], cwd=folder, env=environment(), check=True)
    same(Run(folder).code, 0)
    same(Run(folder).jobs, [])
    for name in files_below(f"{folder}/results/assets"):
        if ".tmp-" in name:
            os.remove(f"{folder}/results/assets/{name}")
    same_as_by_hand(folder, "results/assets", sources)


# ---- Slurm

@case("the page's run on Slurm")
def page_slurm(folder):
    with slurm(folder) as cluster:
        variables = {"SLURM_CONF": cluster.environment["SLURM_CONF"]}
        same(shell(page_block("scenes"), folder).returncode, 0)
        check_page_run(folder, shell(page_block("slurm"), folder, **variables))
        jobs = cluster.run("scontrol", "show", "job", "-o").stdout.splitlines()
        # 7 conversions, one of them retried, and 6 audits
        same(len(jobs), 14)
        same(sorted(re.search(r"JobState=(\w+)", job)[1] for job in jobs), ["COMPLETED"] * 12 + ["FAILED"] * 2)
        asked = [(re.search(r"MinMemoryNode=(\w+)", job)[1], re.search(r"TimeLimit=(\S+)", job)[1]) for job in jobs]
        assert all(memory.endswith("M") for memory, _ in asked), asked
        same([a for job, a in zip(jobs, asked) if "JobState=FAILED" in job], [("203M", "00:10:00"), ("406M", "00:20:00")])
        assert {re.search(r" NodeList=(\w+)", job)[1] for job in jobs} <= {"n1", "n2"}
        done = shell(page_block("slurm"), folder, **variables)
        same((done.returncode, re.findall("^rule (.*):", done.stdout, re.M)), (1, ["convert"] * 2))


def waiting_programs(folder, first="*"):
    """Wrappers that create the file at_work.NODE and wait for the file go if `first` is their first argument."""
    os.makedirs(f"{folder}/waiting")
    for name in ("rgs-convert", "rgs-audit"):
        with open(f"{folder}/waiting/{name}", "w", encoding="utf-8") as file:
            file.write(f'#!/bin/sh\ncase "$1" in\n  --version) ;;\n  {first}) : >"{folder}/at_work.$SLURMD_NODENAME"\n'
                       f'    while ! [ -e "{folder}/go" ]; do sleep 0.1; done ;;\nesac\nexec {BIN}/{name} "$@"\n')
        os.chmod(f"{folder}/waiting/{name}", 0o755)
    return f"{folder}/waiting:{BIN}:{os.environ['PATH']}"


def go(folder):
    open(f"{folder}/go", "wb").close()


@contextlib.contextmanager
def at_work_on(node, folder, cluster, n_scenes):
    """Snakemake, with one of its jobs running on the node until go()."""
    for seed in range(n_scenes):
        make_scene(f"{folder}/scenes/{seed}.ply", seed)
    run = subprocess.Popen(command("slurm", QUICK), cwd=folder, start_new_session=True, stdin=subprocess.DEVNULL,
                           env=environment(SLURM_CONF=cluster.environment["SLURM_CONF"]) |
                           {"PATH": waiting_programs(folder)})
    try:
        wait_for(lambda: os.path.exists(f"{folder}/at_work.{node}"))
        yield run
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()


def check_requeued(folder, cluster, run, n_scenes):
    go(folder)
    same(run.wait(), 0)
    jobs = cluster.run("scontrol", "show", "job", "-o").stdout
    assert re.search(r"Restarts=[1-9]", jobs), "no job was queued again"
    same(results(folder), {str(i): "passed" for i in range(n_scenes)})
    same_as_by_hand(folder, "results/assets", {str(i): f"scenes/{i}.ply" for i in range(n_scenes)})


@case("a node of Slurm is taken down in the middle")
def node_down(folder):
    with slurm(folder) as cluster, at_work_on("n2", folder, cluster, 4) as run:
        cluster.run("scontrol", "update", "NodeName=n2", "State=DOWN", "Reason=test")
        check_requeued(folder, cluster, run, 4)


@case("a node of Slurm dies in the middle")
def node_dies(folder):
    with slurm(folder, slurmd_timeout=6) as cluster, at_work_on("n2", folder, cluster, 4) as run:
        cluster.kill_node("n2")
        check_requeued(folder, cluster, run, 4)
        assert "down" in cluster.states()[1], cluster.states()


@case("Ctrl-C cancels Slurm's jobs")
def interrupted(folder):
    with slurm(folder) as cluster, at_work_on("n1", folder, cluster, 6) as run:
        os.kill(run.pid, signal.SIGINT)
        same(run.wait(), 1)
        wait_for(lambda: not cluster.run("squeue", "--noheader").stdout)


@case("a job's state in Snakemake's words")
def job_states(folder):
    status = f"{SCENES}/profiles/slurm/status.sh"
    with slurm(folder) as cluster:
        def submit(text, *options):
            return cluster.run("sbatch", "--parsable", "--output=/dev/null", *options, "--wrap", text).stdout.strip()

        def is_(word, job):
            wait_for(lambda: cluster.run(status, job).stdout == word + "\n")

        good, bad, long, held = submit("true"), submit("exit 4"), submit("sleep infinity"), submit("true", "--hold")
        is_("success", good)
        is_("failed", bad)
        is_("running", long)
        is_("running", held)
        cluster.run("scancel", long)
        is_("failed", long)
        is_("success", good + ";somewhere")
        is_("failed", "99999")
        cluster.stop("slurmctld")
        is_("running", good)


# ---- without Snakemake

@case("the page's rgs-convert --jobs")
def page_jobs(folder):
    same(shell(page_block("scenes"), folder).returncode, 0)
    same(shell(page_block("jobs"), folder).returncode, 4)
    same_as_by_hand(folder, "by_jobs", PAGE_SCENES)


@case("the page's GNU parallel")
def page_parallel(folder):
    need("parallel")
    same(shell(page_block("scenes"), folder).returncode, 0)
    sources = {source[len("scenes/"):]: source for source in PAGE_SCENES.values()}
    same(shell(page_block("parallel"), folder).returncode, 1)
    same_as_by_hand(folder, "by_parallel", sources)
    before = os.stat(f"{folder}/by_parallel/house1.ply.rgs").st_mtime_ns
    # Repaired, changed, and new ahead of all others, two with the same stem.
    shutil.copy(f"{folder}/scenes/house1.ply", f"{folder}/scenes/cut_off.ply")
    shutil.copy(f"{folder}/scenes/house4.ply", f"{folder}/scenes/house2.ply")
    for name, other in (("a.ply", "house3.ply"), ("a.spz", "old/phone.spz")):
        shutil.copy(f"{folder}/scenes/{other}", f"{folder}/scenes/{name}")
    for name in ("a.ply", "a.spz", "cut_off.ply"):
        sources[name] = "scenes/" + name
    same(shell(page_block("parallel"), folder).returncode, 0)
    same(os.stat(f"{folder}/by_parallel/house1.ply.rgs").st_mtime_ns, before)
    same_as_by_hand(folder, "by_parallel", sources)


@case("the page's array of Slurm")
def page_array(folder):
    with slurm(folder) as cluster:
        variables = {"SLURM_CONF": cluster.environment["SLURM_CONF"]}
        same(shell(page_block("scenes"), folder).returncode, 0)
        same(shell(page_block("array"), folder, **variables).returncode, 4)
        same_as_by_hand(folder, "by_array", PAGE_SCENES)
        lines = []
        for task in (1, 2):
            with open(f"{folder}/array-{task}.jsonl", encoding="utf-8") as file:
                lines += [json.loads(line) for line in file]
        same(len(lines), len(PAGE_SCENES) + 1)
    same(shell(page_block("audit"), folder).returncode, 3)
    with open(f"{folder}/reports/index.json", encoding="utf-8") as file:
        pairs = {pair["name"]: pair["status"] for pair in json.load(file)["pairs"]}
    same(pairs, {"cut_off": "unpaired"} | {name: "passed" for name in PAGE_SCENES})


def main():
    if sys.argv[1:] == ["--list"]:
        print("\n".join(CASES))
        return
    for name in ("rgs-convert", "rgs-audit", "rgs-make-scene"):
        assert os.access(f"{BIN}/{name}", os.X_OK), f"{BIN}/{name} is missing: build it, or set RGS_BIN"
    need("snakemake")
    with tempfile.TemporaryDirectory(prefix="rgs-cluster-") as folder:
        os.chdir(folder)
        CASES[sys.argv[1]](folder)


if __name__ == "__main__":
    main()
