# ask_frames.py - measures how fast rgs-view makes frames, as a page sees it:
#   python3 samples/view/ask_frames.py ADDRESS [--frames N] [--size WxH] [--format jpeg|png] [--quality Q] [--scene I] [--json]
# ADDRESS is what rgs-view printed; start it with --cameras and --backend. Requests the cameras in turn, one at a time over one connection, and
# prints percentiles of the time from a request to its last byte, of drawing and of encoding. SPDX-License-Identifier: Apache-2.0
import argparse
import http.client
import json
import sys
import time
import urllib.parse


def percentile(values, share):
    """By the nearest rank."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -(-len(ordered) * share // 100) - 1))]


def main():
    parser = argparse.ArgumentParser(description="Frames a second of rgs-view.")
    parser.add_argument("address")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--format", choices=("jpeg", "png"), default="jpeg")
    parser.add_argument("--quality", type=int, default=85)
    parser.add_argument("--scene", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    address = urllib.parse.urlsplit(given.address)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=600)

    def ask(method, name, body=None):
        connection.request(method, address.path + name, body, {"Content-Type": "application/json"} if body else {})
        answer = connection.getresponse()
        content = answer.read()
        if answer.status != 200:
            sys.exit(f"ask_frames.py: {name}: {answer.status} {content[:500].decode(errors='replace')}")
        return answer, content

    view = json.loads(ask("GET", "view.json")[1])
    if view["frames"] is None or view["cameras"] is None:
        sys.exit("ask_frames.py: start rgs-view with --backend and --cameras")
    cameras = json.loads(ask("GET", view["cameras"])[1])
    whole, drawn, encoded, sizes = [], [], [], []
    began = None
    for i in range(-1, given.frames):  # the first warms up and is not counted
        if i == 0:
            began = time.perf_counter()
        request = {"scene": given.scene, "camera": cameras[i % len(cameras)], "width": width, "height": height,
                   "format": given.format}
        if given.format == "jpeg":
            request["quality"] = given.quality
        start = time.perf_counter()
        answer, content = ask("POST", view["frames"]["url"], json.dumps(request))
        if i < 0:
            continue
        whole.append(1e3 * (time.perf_counter() - start))
        drawn.append(float(answer.headers["X-Render-Ms"]))
        encoded.append(float(answer.headers["X-Encode-Ms"]))
        sizes.append(len(content))
    seconds = time.perf_counter() - began
    result = {"backend": view["frames"]["backend"], "frames": given.frames, "size": [width, height], "format": given.format,
              "frames_per_second": given.frames / seconds, "mean_bytes": sum(sizes) / len(sizes)}
    for name, values in (("latency_ms", whole), ("render_ms", drawn), ("encode_ms", encoded)):
        result[name] = {f"p{share}": percentile(values, share) for share in (0, 50, 90, 99, 100)}
    if given.json:
        print(json.dumps(result))
        return
    print(f"{given.frames} frames of {given.size}, {given.format}, {result['backend']}: {result['frames_per_second']:.1f} a second, "
          f"{result['mean_bytes'] / 1e3:.0f} kB each")
    for name in ("latency_ms", "render_ms", "encode_ms"):
        print(f"  {name:10}  " + "  ".join(f"{share} {value:8.2f}" for share, value in result[name].items()))


if __name__ == "__main__":
    main()
