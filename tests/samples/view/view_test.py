# view_test.py - the program rgs-view as its users run it: view_test.py CASE PROGRAMS SOURCE. SPDX-License-Identifier: Apache-2.0
import base64
import http.client
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
import zipfile
import zlib
from pathlib import Path

PAGE = "<!doctype html><title>a page of the test</title>"


class NoAddress(Exception):
    """The program's output instead of an address."""


class View:
    """A running rgs-view and its address."""

    def __init__(self, *arguments, environment=None, page=None):
        variables = {**os.environ, "RGS_VIEWER_DIR": str(page or folder / "page"), **(environment or {})}
        # Test runners may ignore some signals, and children inherit that.
        self.process = subprocess.Popen([programs / "rgs-view", "--no-browser", *map(str, arguments)], env=variables,
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                                        preexec_fn=lambda: [signal.signal(s, signal.SIG_DFL) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)])
        line = self.process.stdout.readline()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([0-9a-f]{32})/(#.*)?\n", line)
        if not found:
            raise NoAddress(f"{line!r}: {self.process.stderr.read()}")
        self.port, self.token, self.fragment = int(found[1]), found[2], found[3]

    def ask(self, name, method="GET", body=None, headers=None, path=None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port)
        connection.request(method, path or f"/{self.token}/{name}", body, headers or {})
        answer = connection.getresponse()
        answer.content = answer.read()
        connection.close()
        return answer

    def json(self, name):
        answer = self.ask(name)
        assert answer.status == 200, answer.content
        return json.loads(answer.content)

    def end(self, number=signal.SIGINT):
        self.process.send_signal(number)
        out, err = self.process.communicate()
        assert self.process.returncode == 0, (self.process.returncode, err)
        return out, err

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


def refused(*arguments, environment=None):
    """Exit code and message of a command that starts no server."""
    variables = {**os.environ, "RGS_VIEWER_DIR": str(folder / "page"), **(environment or {})}
    done = subprocess.run([programs / "rgs-view", "--no-browser", *map(str, arguments)], env=variables, capture_output=True,
                          text=True)
    assert done.stdout == "", done.stdout
    return done.returncode, done.stderr


def run(program, *arguments):
    subprocess.run([programs / program, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def scene(n="2k"):
    """A synthetic scene as PLY and .rgs with its cameras."""
    run("rgs-make-scene", "--seed", 1, "--gaussians", n, "--degree", 2, "--cameras", folder / "views.json", folder / "a.ply")
    run("rgs-convert", "--quiet", folder / "a.ply", folder / "a.rgs")


def png_chunks(data, kinds):
    """The PNG chunks of these kinds, joined."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    found, at = [], 8
    while at < len(data):
        size, kind = int.from_bytes(data[at:at + 4], "big"), data[at + 4:at + 8]
        if kind in kinds:
            found.append(data[at + 8:at + 8 + size])
        at += 12 + size
    assert found
    return b"".join(found)


def same_picture(a, b):
    """PNG's filtered rows: both programs use one library, but deflate differently."""
    size, rows = ([png_chunks(png, [kind]) for png in (a, b)] for kind in (b"IHDR", b"IDAT"))
    return size[0] == size[1] and zlib.decompress(rows[0]) == zlib.decompress(rows[1])


def frame(view, **fields):
    return view.ask("frame", "POST", json.dumps(fields), {"Content-Type": "application/json"})


def rendered(path, *arguments):
    out = folder / "rendered.png"
    run("rgs-render", "--quiet", "--backend", "cpu", path, "--overwrite", "-o", out, *arguments)
    return out.read_bytes()


def case_files():
    """Ranges of the scene are its bytes; view.json and cameras.json list the contents."""
    data = random.Random(1).randbytes(700_001)
    golden = (source / "tests/golden/packed_degree3.rgs").read_bytes()
    (folder / "my <b>scene &amp;.rgs").write_bytes(golden)
    (folder / "other.rgs").write_bytes((source / "tests/golden/two.rgs").read_bytes())
    (folder / "page/assets/data.bin").write_bytes(data)
    cameras = [{"name": f"IMG {i}", "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 30,
                "world_to_camera": [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]} for i in range(3)]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    photos = folder / "photos"
    photos.mkdir()
    (photos / "IMG 1.jpg").write_bytes(b"photograph")
    (photos / "IMG 2.tif").write_bytes(b"not for browsers")
    (photos / "unasked.jpg").write_bytes(b"private")
    with View(folder / "my <b>scene &amp;.rgs", folder / "other.rgs", "--cameras", folder / "cameras.json", "--photos", photos) as view:
        assert view.ask("").content.decode() == PAGE
        said = view.json("view.json")
        assert said["version"] == 1 and said["frames"] is None
        assert [s["name"] for s in said["scenes"]] == ["my <b>scene &amp;.rgs", "other.rgs"]
        assert said["scenes"][0]["bytes"] == len(golden)
        assert view.ask(said["scenes"][0]["url"]).content == golden
        assert view.ask(said["scenes"][1]["url"]).content == (folder / "other.rgs").read_bytes()
        entries = view.json(said["cameras"])
        assert [e["img_name"] for e in entries] == ["IMG 0", "IMG 1", "IMG 2"]
        assert entries[2]["position"] == [-2, 0, -4] and entries[2]["cx"] == 30 and entries[2]["cy"] == 24
        assert said["photos"] == [{"camera": "IMG 1", "url": "photos/0.jpg"}]
        assert view.fragment is None
        assert view.ask("photos/0.jpg").content == b"photograph"
        assert view.ask("photos/1.jpg").status == 404
        for _ in range(200):
            first = random.randrange(len(data))
            last = random.randrange(first, len(data) + 1000)
            part = view.ask("assets/data.bin", headers={"Range": f"bytes={first}-{last}"})
            assert part.status == 206 and part.content == data[first:last + 1]
            assert part.headers["Content-Range"] == f"bytes {first}-{min(last, len(data) - 1)}/{len(data)}"
        assert view.ask("assets/data.bin").content == data
        assert view.ask("assets/data.bin", "HEAD").headers["Content-Length"] == str(len(data))
        view.end()


def case_begin():
    """--view puts a camera into the address that is printed."""
    scene()
    with View(folder / "a.rgs", folder / "a.ply", "--cameras", folder / "views.json", "--view=view1") as view:
        entry = view.json("cameras.json")[1]
        said = {k: v[0] for k, v in urllib.parse.parse_qs(view.fragment[1:]).items()}
        assert [float(x) for x in said["at"].split(",")] == entry["position"]
        assert [float(x) for x in said["axes"].split(",")] == sum(entry["rotation"], [])
        assert float(said["lens"].split(",")[0]) == entry["fx"] / entry["width"]
        assert said["mode"] == "slider"
        view.end()
    assert refused(folder / "a.rgs", "--view", "0")[0] == 2
    lenses = [dict(entry, model="orthographic") for entry in json.loads((folder / "views.json").read_text())]
    (folder / "lenses.json").write_text(json.dumps(lenses))
    got, said = refused(folder / "a.rgs", "--cameras", folder / "lenses.json")
    assert got == 4 and "pinhole cameras alone" in said, said
    for name in ("nobody", "all"):
        got, said = refused(folder / "a.rgs", "--cameras", folder / "views.json", "--view", name)
        assert got == 2 and "--view" in said, said


def case_refusals():
    """Unnamed or missing files and malformed requests are refused."""
    (folder / "secret").write_text("nobody's business")
    os.symlink(folder / "secret", folder / "page/link")
    with View(source / "tests/golden/two.rgs") as view:
        def raw(text):
            with socket.create_connection(("127.0.0.1", view.port)) as s:
                s.sendall(text)
                s.shutdown(socket.SHUT_WR)
                parts = []
                while part := s.recv(65536):
                    parts.append(part)
            return b"".join(parts)

        host = f"Host: 127.0.0.1:{view.port}\r\n".encode()
        token = view.token.encode()
        for path in (b"../secret", b"%2e%2e/secret", b"..%2fsecret", b"%2e%2e%2fsecret", b"..%5csecret", b"%252e%252e/secret",
                     b"scenes/0/..%2f..%2f..%2fsecret", b"assets/..%00/secret", b"scenes//etc/passwd",
                     b"..;/secret", b"%c0%ae%c0%ae/secret", b"\xff"):
            said = raw(b"GET /" + token + b"/" + path + b" HTTP/1.1\r\n" + host + b"\r\n")
            assert said.startswith(b"HTTP/1.1 404 "), (path, said)
            assert b"nobody" not in said
        for target in (b"/", b"/../" + token + b"/", b"http://127.0.0.1/" + token + b"/", b"/" + token[:-1] + b"/", b"*"):
            assert raw(b"GET " + target + b" HTTP/1.1\r\n" + host + b"\r\n").startswith(b"HTTP/1.1 403 "), target
        for other in (b"Host: evil.example\r\n", b"", host + host, b"Host: 127.0.0.1\r\n"):
            assert raw(b"GET /" + token + b"/ HTTP/1.1\r\n" + other + b"\r\n").startswith(b"HTTP/1.1 403 "), other
        assert raw(b"GET /" + token + b"/ HTTP/1.0\r\n\r\n").startswith(b"HTTP/1.1 403 ")
        assert view.ask("", headers={"Origin": "http://evil.example"}).status == 403
        assert view.ask("", headers={"Host": f"localhost:{view.port}"}).status == 200
        assert view.ask("", "POST", b"{}").status == 405
        assert view.ask("frame", "POST", b"{}").status == 405  # no frames without --backend
        assert view.ask("", "DELETE").status == 405
        assert view.ask("scenes/0/two.rgs", headers={"Range": "bytes=" + "1-1," * 1500 + "2-2"}).status == 200
        assert view.ask("scenes/0/two.rgs", headers={"Range": f"bytes={10 ** 30}-"}).status == 416
        assert view.ask("x" * 9000).status == 431
        # Files in the page's folder, but no links out of it.
        assert view.ask("link").status == 404
        view.end()


def case_sog():
    """A zipped SOG and an SPZ are served as they are; the page cannot show a SOG folder."""
    meta = json.dumps({"version": 2, "count": 0, "means": {}})
    (folder / "meta.json").write_text(meta)
    with zipfile.ZipFile(folder / "a.sog", "w") as zipped:
        zipped.writestr("meta.json", meta)
    with View(folder / "a.sog") as view:
        url = view.json("view.json")["scenes"][0]["url"]
        assert view.ask(url).content == (folder / "a.sog").read_bytes()
        view.end()
    scene("100")
    run("rgs-convert", "--quiet", folder / "a.ply", folder / "a.spz")
    with View(folder / "a.spz", folder / "a.ply") as view:  # the page reads it itself
        url = view.json("view.json")["scenes"][0]["url"]
        assert view.ask(url).content == (folder / "a.spz").read_bytes()
        view.end()
    got, said = refused(folder / "meta.json")
    assert got == 4 and "meta.json" in said and "rgs-convert" in said, (got, said)


def case_changed():
    """Replacing a file under the server is an error, never a mixture."""
    path = folder / "a.rgs"
    shutil.copy(source / "tests/golden/degree3.rgs", path)
    os.utime(path, (1e9, 1e9))
    with View(path) as view:
        tag = view.ask("scenes/0/a.rgs").headers["ETag"]
        shutil.copy(source / "tests/golden/degree3.rgs", path)  # the same bytes with another time
        answer = view.ask("scenes/0/a.rgs", headers={"Range": "bytes=0-9", "If-Range": tag})
        assert answer.status == 409 and json.loads(answer.content)["error"]["code"] == "read_failed"
        path.unlink()
        assert view.ask("scenes/0/a.rgs").status == 410
        assert view.ask("").status == 200
        view.end()


def case_end():
    """Ctrl-C, SIGTERM and SIGHUP end it with 0 at any time, and leave nothing behind."""
    before = sorted(folder.rglob("*"))
    large = folder / "page/assets/large.bin"
    with open(large, "wb") as out:
        out.truncate(1 << 30)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with View(source / "tests/golden/two.rgs") as view:
            with socket.create_connection(("127.0.0.1", view.port)) as s:
                s.sendall(f"GET /{view.token}/assets/large.bin HTTP/1.1\r\nHost: 127.0.0.1:{view.port}\r\n\r\n".encode())
                assert s.recv(10)  # it is sending now
                view.end(number)
    with View(source / "tests/golden/two.rgs") as view:
        port = view.port
        code, said = refused(source / "tests/golden/two.rgs", "--port", port)
        assert code == 3 and "--port" in said, said
        view.end()
    for _ in range(20):
        try:
            with View(source / "tests/golden/two.rgs", "--port", port) as view:  # the port is free again
                assert view.port == port
                view.end()
            break
        except NoAddress:  # another process took it
            with View(source / "tests/golden/two.rgs") as view:
                port = view.port
                view.end()
    else:
        sys.exit("no port is free again")
    large.unlink()
    assert sorted(folder.rglob("*")) == before


def case_empty():
    """Without a scene the page has nothing to show, and its sample lies beside it."""
    (folder / "page/sample.rgs").write_bytes((source / "tests/golden/two.rgs").read_bytes())
    with View() as view:
        assert view.json("view.json")["scenes"] == []
        head = view.ask("sample.rgs", "HEAD")
        assert (head.status, head.content) == (200, b"")
        assert view.ask("sample.rgs").content == (source / "tests/golden/two.rgs").read_bytes()
        view.end()


def case_usage():
    """Unsupported inputs and contradictions are refused before a server starts."""
    two = source / "tests/golden/two.rgs"
    (folder / "text.txt").write_text("no scene")
    for arguments, code, word in (([folder / "nowhere.rgs"], 3, "nowhere.rgs"), ([folder / "text.txt"], 4, "is not a .rgs"),
                                  ([two, folder / "text.txt"], 4, "text.txt"),
                                  (["--export", folder / "out.html"], 2, "need a scene"), (["--backend", "cpu"], 2, "need a scene"),
                                  ([two, "--photos", folder], 2, "--cameras"), ([two, "--port", "70000"], 2, "--port"),
                                  ([two, "--cameras", folder / "text.txt"], 4, "text.txt")):
        got, said = refused(*arguments)
        assert got == code and word in said, (arguments, got, said)
    scene("100")
    for extension in ("splat", "glb"):  # formats of this project that the page does not read
        other = folder / f"a.{extension}"
        run("rgs-convert", "--quiet", folder / "a.ply", other)
        for arguments in ([other], [two, other], [other, "--backend", "cpu"], [other, "--export", folder / "out.html"]):
            got, said = refused(*arguments)
            assert got == 4 and other.name in said and "rgs-convert makes .rgs" in said, (arguments, got, said)
    (folder / "cameras.json").write_text(json.dumps([{"name": "a", "width": 4, "height": 4, "fx": 4, "fy": 4, "world_to_camera":
                                                      [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]))
    got, said = refused(two, "--cameras", folder / "cameras.json", "--photos", folder)
    assert got == 2 and "name of a camera" in said, said
    got, said = refused(two, environment={"RGS_VIEWER_DIR": str(folder / "nothing")})
    assert got == 3 and "nothing" in said, said


def case_browser():
    """With a screen, xdg-open gets the address as its one argument and inherits nothing else."""
    tools, told, part = folder / "tools", folder / "told", folder / "told.part"
    tools.mkdir()
    (tools / "xdg-open").write_text(f'#!/bin/sh\n{{ printf "%s\\n" "$#" "$1"; ls -l /proc/$$/fd; }} > {part}\nmv {part} {told}\n')
    (tools / "xdg-open").chmod(0o755)
    for screen in ({"DISPLAY": ":99"}, {"WAYLAND_DISPLAY": "wayland-0"}, {}):
        variables = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
        variables.update(screen, PATH=f"{tools}:{os.environ['PATH']}", RGS_VIEWER_DIR=str(folder / "page"))
        process = subprocess.Popen([programs / "rgs-view", source / "tests/golden/two.rgs"], env=variables, stdout=subprocess.PIPE,
                                   text=True)
        try:
            address = process.stdout.readline().strip()
            urllib.request.urlopen(address).close()  # it answers after opening a browser
            if screen:
                while not told.exists():
                    time.sleep(0.02)
                lines = told.read_text().split("\n")
                assert lines[:2] == ["1", address], lines
                assert not any("socket:" in line for line in lines), lines
                told.unlink()
            process.send_signal(signal.SIGINT)
            assert process.wait() == 0
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
    assert not told.exists() and not part.exists()  # nobody wrote it without a screen


def case_frames():
    """PNG frames equal rgs-render's, for .rgs and PLY, at any size and with every option."""
    scene()
    with View(folder / "a.ply", folder / "a.rgs", "--cameras", folder / "views.json", "--backend", "cpu") as view:
        said = view.json("view.json")
        assert said["frames"] == {"url": "frame", "backend": "cpu"}
        (folder / "cameras.json").write_bytes(view.ask("cameras.json").content)
        cameras = view.json("cameras.json")
        assert len(cameras) > 2
        options = ["--cameras", folder / "cameras.json", "--view", "1", "--size", "160x90"]
        for number, path in enumerate((folder / "a.ply", folder / "a.rgs")):
            answer = frame(view, scene=number, camera=cameras[1], width=160, height=90)
            assert answer.status == 200, answer.content
            assert answer.headers["Content-Type"] == "image/png"
            assert float(answer.headers["X-Render-Ms"]) >= 0 and float(answer.headers["X-Encode-Ms"]) >= 0
            assert "X-Pages-Missing" not in answer.headers
            assert same_picture(answer.content, rendered(path, *options))
        answer = frame(view, scene=1, camera=cameras[1], width=160, height=90, background=[1, 0.5, 0.25], sh_degree=0)
        changed = ["--background", "1,0.5,0.25", "--sh-degree", "0"]
        assert same_picture(answer.content, rendered(folder / "a.rgs", *options, *changed))
        assert not same_picture(answer.content, rendered(folder / "a.rgs", *options))
        jpeg = frame(view, scene=1, camera=cameras[1], width=161, height=91, format="jpeg", quality=90)
        assert jpeg.headers["Content-Type"] == "image/jpeg"
        assert jpeg.content[:3] == b"\xff\xd8\xff" and jpeg.content[-2:] == b"\xff\xd9"
        start = jpeg.content.index(b"\xff\xc0")
        assert jpeg.content[start + 5:start + 9] == (91).to_bytes(2, "big") + (161).to_bytes(2, "big")
        smaller = frame(view, scene=1, camera=cameras[1], width=161, height=91, format="jpeg", quality=20)
        assert len(smaller.content) < len(jpeg.content)
        view.end()


def case_frame_refusals():
    """Nonsensical requests for frames return errors in JSON, and the server goes on."""
    scene()
    with View(folder / "a.rgs", "--cameras", folder / "views.json", "--backend", "cpu") as view:
        camera = view.json("cameras.json")[0]

        def refusal(answer):
            assert answer.headers["Content-Type"] == "application/json"
            return answer.status, json.loads(answer.content)["error"]["code"]

        assert refusal(frame(view, camera=camera, width=8193, height=10)) == (400, "bad_argument")
        assert refusal(frame(view, camera=camera, scene=1)) == (400, "bad_argument")
        assert refusal(frame(view, camera={**camera, "fx": -1})) == (400, "bad_value")
        assert refusal(frame(view, camera=camera, out="/tmp/x.png")) == (400, "bad_syntax")
        assert refusal(view.ask("frame", "POST", b"{")) == (400, "bad_syntax")
        assert refusal(view.ask("frame", "POST", b" " * 65537)) == (413, "too_large")
        assert refusal(view.ask("frame", "POST", iter([b"{}"]), {"Transfer-Encoding": "chunked"})) == (411, "no_length")
        assert refusal(view.ask("frame")) == (405, "bad_method")
        assert refusal(view.ask("frame", "POST", b"{}", {"Origin": "null"})) == (403, "other_origin")
        assert refusal(view.ask("", "POST", b"{}", path="/frame")) == (403, "wrong_token")
        assert frame(view, camera=camera, width=16, height=16).status == 200
        view.end()


def case_streamed():
    """A file with levels of detail is streamed; a complete view equals one from the whole file."""
    scene("20k")
    run("rgs-convert", "--quiet", "--lod", folder / "a.ply", folder / "levels.rgs")
    with View(folder / "levels.rgs", folder / "a.ply", "--cameras", folder / "views.json", "--host-memory", "200MB") as view:
        cameras = view.json("cameras.json")
        (folder / "cameras.json").write_bytes(view.ask("cameras.json").content)
        for detail in (1, 0):
            while True:
                answer = frame(view, camera=cameras[0], width=200, height=150, detail=detail)
                assert answer.status == 200, answer.content
                assert "X-Scene-Error" not in answer.headers
                if answer.headers["X-Pages-Missing"] == "0":
                    break
            assert 0 <= float(answer.headers["X-Detail-Px"]) <= max(detail, 1e-6)
            options = ["--cameras", folder / "cameras.json", "--view", "0", "--size", "200x150", "--detail", detail]
            assert same_picture(answer.content, rendered(folder / "levels.rgs", *options))
        assert "X-Pages-Missing" not in frame(view, scene=1, camera=cameras[0], width=20, height=15).headers
        view.end()
    for arguments, code, word in ((["--host-memory", "100MB", folder / "a.rgs"], 2, "--lod"),
                                  (["--host-memory", "1", folder / "levels.rgs"], 3, "levels.rgs"),
                                  (["--host-memory", "0", folder / "levels.rgs"], 2, "--host-memory"),
                                  (["--backend", "cpu", "--device-memory", "1GB", folder / "levels.rgs"], 2, "--device-memory"),
                                  (["--backend", "cuda", "--host-memory", "1GB", folder / "levels.rgs"], 2, "--device-memory")):
        got, said = refused(*arguments)
        assert (got == code or code == 3 and got == 4) and word in said, (arguments, got, said)


def case_damaged():
    """A damaged scene fails before the server starts, or in the frames that show it."""
    scene()
    data = bytearray((folder / "a.rgs").read_bytes())
    data[len(data) // 2] ^= 0x40
    (folder / "damaged.rgs").write_bytes(data)
    got, said = refused(folder / "damaged.rgs", "--backend", "cpu")
    assert got == 4 and "damaged.rgs" in said, (got, said)
    with View(folder / "damaged.rgs") as view:  # the page reports the damage
        assert view.ask("scenes/0/damaged.rgs").content == bytes(data)
        view.end()
    with View(folder / "a.rgs", "--cameras", folder / "views.json", "--backend", "cpu") as view:
        camera = view.json("cameras.json")[0]
        assert frame(view, camera=camera, width=16, height=16).status == 200
        os.utime(folder / "a.rgs", (1e9, 1e9))
        answer = frame(view, camera=camera, width=16, height=16)
        assert answer.status == 500 and json.loads(answer.content)["error"]["code"] == "read_failed", answer.content
        view.end()


def case_export():
    """--export writes one file with the scenes, cameras and photographs, once and within its limit."""
    single = "<!doctype html><head><!-- rgs-view:insert --></head><body></body>"
    (folder / "page/single.html").write_text(single)
    scene()
    photos = folder / "photos"
    photos.mkdir()
    (photos / "view0.png").write_bytes(b"photograph")
    out = folder / "out.html"
    variables = {**os.environ, "RGS_VIEWER_DIR": str(folder / "page")}
    before = sorted(folder.rglob("*"))

    def export(*arguments, to=out):
        return subprocess.run([programs / "rgs-view", *map(str, arguments), "--export", to], env=variables, capture_output=True, text=True)

    shown = [folder / "a.rgs", folder / "a.ply", "--cameras", folder / "views.json", "--photos", photos]
    small = export(*shown, "--export-limit", "100kB")
    assert small.returncode == 2 and "--export-limit" in small.stderr and sorted(folder.rglob("*")) == before, small
    done = export(*shown)
    assert done.returncode == 0, done.stderr
    text = out.read_text()
    assert done.stdout == f"{out}: {len(text) / 1e6:.1f} MB\n" or done.stdout == f"{out}: {len(text) / 1e3:.1f} kB\n", done.stdout
    elements = {m[1]: m[2] for m in re.finditer(r'<script type="[^"]*" id="(rgs-[^"]*)">([^<]*)</script>', text)}
    said = json.loads(elements["rgs-view"])
    assert said["frames"] is None

    def content(url):
        return base64.b64decode(elements[url.removeprefix("#")], validate=True)

    assert [content(s["url"]) for s in said["scenes"]] == [(folder / "a.rgs").read_bytes(), (folder / "a.ply").read_bytes()]
    assert [s["name"] for s in said["scenes"]] == ["a.rgs", "a.ply"]
    assert len(json.loads(content(said["cameras"]))) == len(json.loads((folder / "views.json").read_text()))
    assert [(p["camera"], content(p["url"])) for p in said["photos"]] == [("view0", b"photograph")]
    again = export(folder / "a.rgs")
    assert again.returncode == 3 and "--overwrite" in again.stderr and out.read_text() == text
    assert export(folder / "a.rgs", "--overwrite").returncode == 0 and len(out.read_text()) < len(text)
    assert export(folder / "a.rgs", "--overwrite", to=folder / "a.rgs").returncode == 2
    assert export(folder / "a.rgs", "--backend", "cpu", "--overwrite").returncode == 2
    piped = export(folder / "a.rgs", to="-")
    assert piped.returncode == 0 and piped.stdout == out.read_text()
    (folder / "page/single.html").write_text("<html></html>")
    assert export(folder / "a.rgs", "--overwrite").returncode == 4
    (folder / "page/single.html").unlink()
    assert export(folder / "a.rgs", "--overwrite").returncode == 3
    assert sorted(p for p in folder.rglob("*") if ".tmp" in p.name) == []


CASES = {name.removeprefix("case_"): value for name, value in list(globals().items()) if name.startswith("case_")}

if __name__ == "__main__":
    wanted, programs, source = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    with tempfile.TemporaryDirectory(prefix="rgs-test-") as name:
        folder = Path(name)
        (folder / "page/assets").mkdir(parents=True)
        (folder / "page/index.html").write_text(PAGE)
        CASES[wanted]()
    print(f"{wanted}: ok")
