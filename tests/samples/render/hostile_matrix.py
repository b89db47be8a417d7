# hostile_matrix.py - programs that read addresses against every fault of tests/support/hostile_server.py:
#   hostile_matrix.py BIN_DIR [--long] [--python] [--only NAME]
# Whatever the server does, the program ends by itself with exit code 0, 3, 4 or 6: 0 with the picture of the local file,
# 6 with a coarser one and its error, 3 or 4 with none and a message that names the address. --long: more faults at more
# requests, also in real time, with how long each run took. --python: roofgs on PYTHONPATH, too.
# SPDX-License-Identifier: Apache-2.0
import argparse
import collections
import concurrent.futures
import os
import pathlib
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse
import zlib

SERVER = pathlib.Path(__file__).resolve().parents[2] / "support/hostile_server.py"
SIZE = "96x64"

# Answers that are unusual but right, or wrong for a while: the picture is complete, however long it takes.
SERVED = [
    "plain?", "plain?etag=a&", "early-hints?", "old?", "longer?", "redirect?to=PLAIN&", "many-lines?n=10&", "endless?",
    "truncated?times=1&", "truncated-chunked?times=1&", "reset?times=1&", "reset-at-once?times=1&", "hang-up?times=1&",
    "head-alone?times=1&", "status?code=503&times=2&", "status?code=429&retry_after=0&times=1&", "slow?rate=1000000&",
    "flipped?times=1&from=2&",
]

# Wrong for good.
FAULTS = [
    "silent?", "slow?all&rate=1&", "stall?", "slow-head?", "hang-up?", "reset?", "reset-at-once?", "head-alone?",
    "truncated?", "truncated-chunked?", "short-length?", "longer-length?", "other-range?", "multipart?", "two-ranges?",
    "lying-range?range=bytes+0-9/300000&", "lying-range?range=nonsense&", "lying-range?range=bytes+0-65535/*&",
    "lying-range?range=bytes+0-65535/18446744073709551615&", "no-ranges?", "no-ranges-chunked?",
    "no-ranges-unknown-length?", "no-ranges-broken?breaks=1000&", "gzip?", "really-gzip?", "garbage?", "no-head?",
    "no-status?", "zero-in-head?", "no-header-colon?", "long-line?", "many-lines?", "many-informations?",
    "bad-chunk?size=zz&", "bad-chunk?size=-1&", "bad-chunk?size=ffffffffffffffffffff&", "other-length?length=-1&",
    "other-length?length=99999999999999999999&", "other-length?length=1&", "other-length?length=10&twice&",
    "flipped?", "flipped?every=65537&", "zeros?", "shifted?", "loop?", "chain?n=99&", "redirect-nowhere?",
    "redirect?to=file:///etc/passwd&", "redirect?to=http://127.0.0.1:1/&", "redirect?to=//&", "endless-redirect?to=/loop&",
    "status?code=503&retry_after=99999999999999999999&", "status?code=429&retry_after=-1&",
    "status?code=503&retry_after=Fri,+31+Dec+9999+23:59:59+GMT&", "endless-error?code=500&",
    "plain?etag=a&etag2=b&", "plain?size2=1000&", "plain?modified=x&modified2=y&", "plain?etag=a&size2=99999999&",
]
FAULTS += [f"status?code={code}&" for code in (204, 304, 400, 401, 403, 404, 410, 416, 418, 500, 503)]


def pixels(path):
    """Bytes of an 8-bit RGB PNG, unfiltered."""
    data, at, packed = path.read_bytes(), 8, b""
    while at < len(data):
        (n,), kind = struct.unpack(">I", data[at:at + 4]), data[at + 4:at + 8]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", data[at + 8:at + 18])
            assert (depth, colour) == (8, 2), "an 8-bit RGB PNG was expected"
        packed += data[at + 8:at + 8 + n] if kind == b"IDAT" else b""
        at += n + 12
    raw, out, stride = zlib.decompress(packed), bytearray(), 3 * width
    above = bytes(stride)
    for y in range(height):
        filtered, row = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1:(y + 1) * (stride + 1)])
        for i in range(stride):
            a, b, c = (row[i - 3] if i >= 3 else 0), above[i], (above[i - 3] if i >= 3 else 0)
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            row[i] = (row[i] + (0, a, b, (a + b) // 2, nearest)[filtered]) & 0xFF
        out += row
        above = row
    return bytes(out)


def difference(a, b):
    return sum(abs(x - y) for x, y in zip(a, b)) / len(a)


class Matrix:
    def __init__(self, bin_dir, folder):
        self.bin, self.folder = pathlib.Path(bin_dir), pathlib.Path(folder)
        self.scene, self.cameras = self.folder / "town.rgs", self.folder / "cameras.json"
        self.run([self.bin / "rgs-make-scene", "--town", "--gaussians", "60k", "--degree", "0", "--no-sync", "--quiet",
                  "--cameras", self.cameras, self.scene])
        self.complete = self.local("complete.png", "0.5")
        self.pixels = pixels(self.complete)
        # Pages that have come make a picture better than the root, so no honest one is much worse than this.
        self.coarsest = difference(self.pixels, pixels(self.local("root.png", "1e6")))
        self.servers, self.ports, self.n, self.lock = [], {}, 0, threading.Lock()
        self.failures, self.times = [], []

    def run(self, command, **options):
        return subprocess.run([str(c) for c in command], check=True, **options)

    def render(self, scene, out, detail="0.5"):
        return [self.bin / "rgs-render", scene, "--cameras", self.cameras, "--view", "0", "--size", SIZE, "--detail", detail,
                "--backend", "cpu", "--overwrite", "--out", out]

    def local(self, name, detail):
        out = self.folder / name
        self.run([*self.render(self.scene, out, detail), "--host-memory", "256MiB", "--quiet"])
        return out

    def url(self, fault, more=""):
        """A new address, which counts its requests from 1. `fault`: of SERVED or FAULTS, or raw:NAME or tls:NAME."""
        raw = fault.split(":")[1] if fault.startswith(("raw:", "tls:")) else None
        with self.lock:
            self.n += 1
            number = self.n
            if raw not in self.ports:
                server = subprocess.Popen([sys.executable, "-B", SERVER, *([raw] if raw else [])], stdout=subprocess.PIPE,
                                          text=True)
                self.servers.append(server)
                self.ports[raw] = int(server.stdout.readline().split()[1])
                threading.Thread(target=server.stdout.read, daemon=True).start()
        host = f"http{'s' if fault.startswith('tls:') else ''}://127.0.0.1:{self.ports[raw]}/"
        file = f"file={urllib.parse.quote(str(self.scene))}&id={number}"
        return host + ("x" if raw else fault.replace("PLAIN", urllib.parse.quote(f"/plain?{file}")) + more + file)

    def check(self, name, is_right, *context):
        if not is_right:
            self.failures.append(name)
            print("FAILED:", name, *context, file=sys.stderr, flush=True)

    def one(self, fault, more, seconds, must_be_complete=False, realtime=False):
        url = self.url(fault, more)
        out = self.folder / f"{url.split('=')[-1].replace('/', '_')}-{threading.get_ident()}.png"
        out.unlink(missing_ok=True)
        command = self.render(url, out)
        if realtime:
            out = out.with_suffix("")
            command = [self.bin / "rgs-render", url, "--path", self.cameras, "--frames", "3", "--realtime", "20", "--size",
                       SIZE, "--backend", "cpu", "--overwrite", "--out", out]
        else:
            command += ["--wait", str(seconds)]
        began = time.monotonic()
        done = subprocess.run([str(c) for c in command], capture_output=True, text=True, errors="replace",
                              env={**os.environ, "no_proxy": "127.0.0.1", "LC_ALL": "C"})
        name = f"{fault}{more}" + (" in real time" if realtime else "")
        self.times.append((time.monotonic() - began, done.returncode, name))
        said = (done.returncode, done.stdout, done.stderr)
        self.check(name, done.returncode in ((0,) if must_be_complete else (0, 3, 4, 6)), said)
        if done.returncode in (3, 4):
            self.check(name, f"rgs-render: {url.split('?')[0]}: " in done.stderr and not out.is_file(), said)
        elif not realtime:
            self.check(name, out.is_file(), said)
            if done.returncode == 0:
                self.check(name, out.read_bytes() == self.complete.read_bytes(), "another picture", said)
            elif out.is_file():
                off = difference(pixels(out), self.pixels)
                self.check(name, off <= 1.5 * self.coarsest and "its error is" in done.stderr, f"off by {off}", said)

    def one_in_python(self, fault, more, seconds):
        import numpy
        import roofgs
        url, name = self.url(fault, more), f"{fault}{more} in Python"
        renderer = roofgs.Renderer(device="cpu")

        def picture(path, seconds):
            with roofgs.StreamedScene(path, open_seconds=seconds) as scene:
                camera = roofgs.cameras.default_view(scene, width=96, height=64)
                return renderer.refine(scene, camera, seconds), renderer.render(scene, camera)

        began = time.monotonic()
        try:
            is_complete, image = picture(url, seconds)
            if is_complete:
                self.check(name, numpy.array_equal(image, picture(self.scene, 1e4)[1]), "another picture")
        except roofgs.Error as error:
            self.check(name, str(error) != "", repr(error))
        self.times.append((time.monotonic() - began, "", name))


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("bin")
    arguments.add_argument("--long", action="store_true")
    arguments.add_argument("--python", action="store_true")
    arguments.add_argument("--only", default="")
    options = arguments.parse_args()
    os.environ["no_proxy"] = "127.0.0.1"
    raw = [f"{scheme}:{name}" for scheme in ("raw", "tls") for name in
           ("silent", "close", "garbage", "banner", "tls-alert", "tls-half", "tls-long", "answer")]
    with tempfile.TemporaryDirectory() as folder:
        matrix = Matrix(options.bin, folder)
        jobs = [(matrix.one, fault, "", 86400, True) for fault in SERVED]
        wait = 2 if options.long else 0.2
        for fault in FAULTS:
            for first in ((1, 2, 3, 5) if options.long else (1, 2)):
                jobs.append((matrix.one, fault, f"from={first}&", wait))
                if options.long:
                    jobs.append((matrix.one, fault, f"from={first}&times=2&", wait))
        jobs += [(matrix.one, fault, "", wait) for fault in raw]
        if options.long:
            jobs += [(matrix.one, fault, "from=2&", wait, False, True) for fault in FAULTS]
        if options.python:
            jobs += [(matrix.one_in_python, fault, f"from={first}&", wait) for fault in FAULTS for first in (1, 2)]
        jobs = [job for job in jobs if options.only in job[1]]
        try:
            with concurrent.futures.ThreadPoolExecutor(4) as pool:
                for future in [pool.submit(job[0], *job[1:]) for job in jobs]:
                    future.result()
        finally:
            for server in matrix.servers:
                server.kill()
                server.wait()
        codes = dict(sorted(collections.Counter(str(code) for _, code, _ in matrix.times).items()))
        print(len(jobs), "runs, by exit code:", codes, "failures:", len(matrix.failures))
        print("longest:")
        for seconds, code, name in sorted(matrix.times, key=lambda run: -run[0])[:10]:
            print(f"{seconds:8.1f} s  exit code {code}  {name}")
        return 1 if matrix.failures else 0


sys.exit(main())
