# hostile_server.py - a web server on 127.0.0.1 that misbehaves on demand; prints its port, then a line for each
# request.
#
# The path names the fault (the functions below; /plain has none), parameters say when and with what:
#   from=N      requests before the Nth to this exact address are answered correctly (1: none)
#   times=N     at most N requests get the fault; 0: no limit
#   size=N      of the generated file, at most 400000; file=PATH serves another
#   etag=, modified=   of the file; absent: no such header. etag2=, modified2=, size2= hold from the Nth request on
# A line: "GET ADDRESS range=... auth=... agent=... encoding=..."
# With an argument, one of RAW below, every connection gets that instead of HTTP.
# SPDX-License-Identifier: Apache-2.0
import collections
import fcntl
import os
import re
import socket
import struct
import sys
import termios
import threading
import time
import urllib.parse
import zlib

FIRST = "bytes=0-65535"


MADE = bytes(((offset * 2654435761) >> 13) & 0xFF for offset in range(400000))  # the same bytes as tests/support/made_bytes.hpp


class File:
    def __init__(self, options, later):
        self.path = options.get("file")
        self.size = os.path.getsize(self.path) if self.path else int(options.get("size", 300000))
        self.etag, self.modified = options.get("etag"), options.get("modified")
        if later:
            self.size = int(options.get("size2", self.size))
            self.etag = options.get("etag2", self.etag)
            self.modified = options.get("modified2", self.modified)

    def bytes(self, begin, end):
        if not self.path:
            return MADE[begin:end]
        with open(self.path, "rb") as file:
            file.seek(begin)
            return file.read(end - begin)


class Request:
    """One request and the means to answer it. begin, end: the requested range, cut at the file's end."""

    def __init__(self, connection, address, fields, options, file):
        self.connection, self.address, self.fields, self.options, self.file = connection, address, fields, options, file
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", fields.get("range", ""))
        self.begin, self.end = (int(match[1]), min(int(match[2]) + 1, file.size)) if match else (0, file.size)

    def body(self):
        return self.file.bytes(self.begin, self.end)

    def send(self, data):
        self.connection.sendall(data)

    def head(self, status=206, *, range=None, length=None, more=(), version="1.1"):
        lines = [f"HTTP/{version} {status} whatever"]
        if status == 206 and range is None:
            range = f"bytes {self.begin}-{self.end - 1}/{self.file.size}"
        if range:
            lines.append(f"Content-Range: {range}")
        if length is not None:
            lines.append(f"Content-Length: {length}")
        if self.file.etag:
            lines.append(f"ETag: {self.file.etag}")
        if self.file.modified:
            lines.append(f"Last-Modified: {self.file.modified}")
        self.send("\r\n".join([*lines, *more, "", ""]).encode())

    def answer(self, status=206, **fields):
        body = self.body()
        self.head(status, **{"length": len(body), **fields})
        self.send(body)

    def wait_until_taken(self):
        """Waits until the client has everything that was sent."""
        while struct.unpack("i", fcntl.ioctl(self.connection, termios.TIOCOUTQ, bytes(4)))[0] > 0:
            time.sleep(0.001)

    def hang(self):
        """Waits until the client closes."""
        while self.connection.recv(4096):
            pass

    def reset(self):
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()


# Faults. True: the connection stays open.

def plain(r):
    if r.begin >= r.file.size:
        r.head(416, range=f"bytes */{r.file.size}", length=0)
    else:
        r.answer()
    return True


def no_ranges(r):
    r.begin, r.end = 0, r.file.size
    r.answer(200)


def no_ranges_broken(r):
    """The first answers break off; the file then `grows`."""
    with lock:
        counts["broken", r.address] += 1
        is_broken = counts["broken", r.address] <= int(r.options["breaks"])
    r.begin, r.end = 0, r.file.size + (0 if is_broken else int(r.options.get("grows", 0)))
    body = r.body()
    r.head(200, length=len(body))
    r.send(body[:len(body) // 2] if is_broken else body)


def no_ranges_chunked(r):
    data = r.file.bytes(0, r.file.size)
    r.head(200, more=["Transfer-Encoding: chunked"])
    r.send(b"%x\r\n" % len(data) + data + b"\r\n0\r\n\r\n")


def no_ranges_unknown_length(r):
    r.head(200, more=["Connection: close"])
    r.send(r.file.bytes(0, r.file.size))


def status(r):
    text = b"<html>no</html>"
    more = ["Retry-After: " + r.options["retry_after"]] if "retry_after" in r.options else []
    r.head(int(r.options["code"]), length=len(text), more=more, range=r.options.get("range"))
    r.send(text)
    return True


def endless_error(r):
    r.head(int(r.options["code"]))
    while True:
        r.send(b"no" * 5000)
        time.sleep(0.01)


def truncated(r):
    body = r.body()
    r.head(length=len(body))
    r.send(body[:max(1, len(body) // 2)])


def truncated_chunked(r):
    body = r.body()
    r.head(more=["Transfer-Encoding: chunked"])
    half = body[:max(1, len(body) // 2)]
    r.send(b"%x\r\n" % len(half) + half + b"\r\n")


def short_length(r):
    """A body shorter than its range; everything else is right."""
    body = r.body()[:-7]
    r.head(length=len(body))
    r.send(body)
    return True


def head_alone(r):
    r.head(length=r.end - r.begin)


def other_range(r):
    r.begin, r.end = r.begin + 1, min(r.end + 1, r.file.size)
    r.answer()


def lying_range(r):
    """The bytes of another range, labelled as the right one."""
    r.answer(range=r.options["range"])


def longer(r):
    """In chunks, so that only the range states the size."""
    body = r.body() + bytes(1 << 20)
    r.head(more=["Transfer-Encoding: chunked"])
    r.send(b"%x\r\n" % len(body) + body + b"\r\n0\r\n\r\n")


def longer_length(r):
    body = r.body() + bytes(1 << 20)
    r.head(length=len(body))
    r.send(body)


def endless(r):
    r.head(more=["Connection: close"])
    r.send(r.body())
    while True:
        r.send(bytes(1 << 16))


def slow(r):
    """Limited bytes per second; the first request is answered at once unless `all` is set."""
    if r.fields["range"] == FIRST and "all" not in r.options:
        return plain(r)
    body, step = r.body(), max(1, int(r.options.get("rate", 1000)) // 20)
    r.head(length=len(body))
    for i in range(0, len(body), step):
        r.send(body[i:i + step])
        time.sleep(0.05)
    return True


def stall(r):
    body = r.body()
    r.head(length=len(body))
    r.send(body[:int(r.options.get("after", 1000))])
    r.hang()


def silent(r):
    r.hang()


def slow_head(r):
    r.send(b"HTTP/1.1 206 whatever\r\n")
    while True:
        r.send(b"X-Nothing: nothing\r\n")
        time.sleep(0.05)


def reset(r):
    body = r.body()
    r.head(length=len(body))
    r.send(body[:len(body) // 2])
    r.wait_until_taken()  # otherwise the reset overtakes what was sent
    r.reset()


def reset_at_once(r):
    r.reset()


def hang_up(r):
    pass


def redirect(r):
    r.head(int(r.options.get("code", 302)), length=4, more=["Location: " + r.options["to"]])
    r.send(b"away")
    return True


def redirect_nowhere(r):
    r.head(302, length=0)
    return True


def endless_redirect(r):
    r.head(302, more=["Location: " + r.options["to"]])
    while True:
        r.send(bytes(1 << 12))
        time.sleep(0.01)


def chain(r):
    n = int(r.options["n"])
    r.head(301, length=0, more=[f"Location: chain?n={n - 1}" if n > 1 else "Location: /plain?chained"])
    return True


def loop(r):
    r.head(302, length=0, more=["Location: " + r.address])
    return True


def gzip(r):
    r.answer(more=["Content-Encoding: gzip"])


def multipart(r):
    body = r.body()
    text = b"--x\r\nContent-Range: bytes %d-%d/%d\r\n\r\n" % (r.begin, r.end - 1, r.file.size) + body + b"\r\n--x--\r\n"
    r.head(range=False, length=len(text), more=["Content-Type: multipart/byteranges; boundary=x"])
    r.send(text)


def two_ranges(r):
    r.answer(more=[f"Content-Range: bytes {r.begin + 1}-{r.end}/{r.file.size}"])


def old(r):
    """HTTP/1.0: the body ends with the connection."""
    r.head(version="1.0")
    r.send(r.body())


def long_line(r):
    r.send(b"HTTP/1.1 206 whatever\r\nX-Long: ")
    for _ in range(100):
        r.send(b"x" * 100000)
    r.send(b"\r\n\r\n")


def many_lines(r):
    r.send(b"HTTP/1.1 206 whatever\r\n")
    for i in range(int(r.options.get("n", 10000))):
        r.send(b"X-Line-%d: " % i + b"x" * 1000 + b"\r\n")
    body = r.body()
    r.send(b"Content-Range: bytes %d-%d/%d\r\n\r\n" % (r.begin, r.end - 1, r.file.size) + body)


def many_informations(r):
    while True:
        r.send(b"HTTP/1.1 103 Early Hints\r\nLink: nothing\r\n\r\n" * 100)


def bad_chunk(r):
    """`size` is the chunk's, in the server's words."""
    body = r.body()
    r.head(more=["Transfer-Encoding: chunked"])
    r.send(r.options["size"].encode() + b"\r\n" + body + b"\r\n0\r\n\r\n")


def other_length(r):
    """Content-Length is `length`; with `twice` also the right one."""
    body = r.body()
    r.head(length=r.options["length"], more=[f"Content-Length: {len(body)}"] if "twice" in r.options else ())
    r.send(body)


def flipped(r):
    """The right bytes, but for every `every`th of the file."""
    body, every = bytearray(r.body()), int(r.options.get("every", 4099))
    for i in range(-r.begin % every, len(body), every):
        body[i] ^= 0x40
    r.head(length=len(body))
    r.send(body)
    return True


def zeros(r):
    r.head(length=r.end - r.begin)
    r.send(bytes(r.end - r.begin))
    return True


def shifted(r):
    """The bytes of another range, labelled as the right one."""
    body = r.file.bytes(max(0, r.begin - 4096), max(0, r.begin - 4096) + r.end - r.begin)
    r.head(length=len(body))
    r.send(body)
    return True


def really_gzip(r):
    body = zlib.compress(r.body(), wbits=31)
    r.head(length=len(body), more=["Content-Encoding: gzip"])
    r.send(body)
    return True


def no_head(r):
    r.send(r.body())


def zero_in_head(r):
    r.send(b"HTTP/1.1 206 what\0ever\r\nX: \0\r\n")
    r.answer()


def no_status(r):
    r.send(b"HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc")


def early_hints(r):
    r.send(b"HTTP/1.1 103 Early Hints\r\nContent-Range: bytes 0-1/2\r\nETag: other\r\n\r\n")
    return plain(r)


def garbage(r):
    r.send(b"\x16\x03\x01\x02\x00" * 100)


def no_header_colon(r):
    r.send(b"HTTP/1.1 206 whatever\r\nContent-Range bytes 0-65535/300000\r\n\r\n")


def busy(r):
    """The first requests wait until `n` are in flight; the log states the largest number."""
    with changed:
        at_work[0] += 1
        at_work[1] = max(at_work)
        print("at work", at_work[1], flush=True)
        changed.notify_all()
        changed.wait_for(lambda: at_work[1] >= int(r.options["n"]))
        at_work[0] -= 1
    return plain(r)


# What a connection gets that is not HTTP.
RAW = {"silent": b"", "close": None, "garbage": bytes(range(256)) * 40, "banner": b"SSH-2.0-nobody\r\n",
       "tls-alert": b"\x15\x03\x03\x00\x02\x02\x28", "tls-half": b"\x16\x03\x03\x00\x7a\x02\x00\x00\x76\x03\x03",
       "tls-long": b"\x16\x03\x03\xff\xff" + bytes(65535), "answer": b"HTTP/1.1 206 early\r\n\r\n"}


def serve_raw(connection, said):
    try:
        if said is not None:
            connection.sendall(said)
            while connection.recv(4096):
                pass
    except OSError:
        pass
    finally:
        connection.close()


lock = threading.Lock()
changed = threading.Condition(lock)
at_work = [0, 0]
counts = collections.Counter()


def read_head(connection, rest):
    while b"\r\n\r\n" not in rest:
        data = connection.recv(65536)
        if not data:
            return None, rest
        rest += data
    return rest.split(b"\r\n\r\n", 1)


def serve(connection):
    rest = b""
    try:
        while True:
            head, rest = read_head(connection, rest)
            if head is None:
                return
            lines = head.decode("latin1").split("\r\n")
            method, address, _ = lines[0].split(" ")
            fields = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in lines[1:])}
            parts = urllib.parse.urlsplit(address)
            options = dict(urllib.parse.parse_qsl(parts.query, keep_blank_values=True))
            with lock:
                counts[address] += 1
                n = counts[address]
                print(method, address, "range=" + fields.get("range", ""), "auth=" + fields.get("authorization", ""),
                      "agent=" + fields.get("user-agent", ""), "encoding=" + fields.get("accept-encoding", ""),
                      "cookie=" + fields.get("cookie", ""), "if-range=" + fields.get("if-range", ""), flush=True)
            first, times = int(options.get("from", 1)), int(options.get("times", 0))
            wrong = n >= first and (times == 0 or n < first + times)
            request = Request(connection, address, fields, options, File(options, wrong))
            if not (globals()[parts.path[1:].replace("-", "_")] if wrong else plain)(request):
                return
    except OSError:
        pass
    finally:
        connection.close()


listener = socket.create_server(("127.0.0.1", 0), backlog=64)
print("port", listener.getsockname()[1], flush=True)
while True:
    connection = listener.accept()[0]
    target, args = (serve_raw, (connection, RAW[sys.argv[1]])) if len(sys.argv) > 1 else (serve, (connection,))
    threading.Thread(target=target, args=args, daemon=True).start()
