# sbom.py - an SPDX 2.3 document of a release's packages and what is inside them: python3 scripts/sbom.py FOLDER VERSION > JSON
# Read from the packages: licences of Debian's libraries name them, NOTICE files what is in WebAssembly and in the page. Versions
# are those of this machine's dpkg (for arm64 that of build/roots), and of web/package-lock.json. SOURCE_DATE_EPOCH is its date.
# Libraries of headers alone have entries for WebAssembly, the page and Windows: no file of other packages names them.
# SPDX-License-Identifier: Apache-2.0
import datetime
import hashlib
import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = json.loads((ROOT / "web/package-lock.json").read_text())["packages"]
ZSTD = ROOT / "web/node_modules/zstd-napi/deps/zstd/lib/zstd.h"


def members(path):
    """The bytes of each file in it by its name."""
    if path.suffix in (".whl", ".zip"):
        with zipfile.ZipFile(path) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    with tarfile.open(path) as archive:
        return {member.name: archive.extractfile(member).read() for member in archive if member.isfile()}


def debian(name, status, copyright_file=b""):
    """A Debian package; its version is left out where `status`, a folder of dpkg's, does not have it."""
    found = subprocess.run(["dpkg-query", f"--admindir={status}", "-W", "-f", "${Version}\\n", name], capture_output=True, text=True)
    # A line for each architecture.
    version = found.stdout.partition("\n")[0]
    package = {"name": name, "supplier": "Organization: Debian", "versionInfo": version} if version else {"name": name}
    names = sorted(set(re.findall(r"^License: *(\S.*?)\s*$", copyright_file.decode(errors="replace"), re.MULTILINE)))
    if names:
        package["licenseComments"] = "Debian's copyright file names: " + ", ".join(names)
    return package


def npm(name):
    locked = LOCK.get(f"node_modules/{name}", {})
    if "link" in locked:
        locked = LOCK[locked["resolved"]]
    package = {"name": name, **({"versionInfo": locked["version"]} if "version" in locked else {})}
    if re.fullmatch(r"[\w.-]+", locked.get("license", "")):
        package["licenseDeclared"] = locked["license"]
    return package


def noticed(notice):
    """What a NOTICE file of web names."""
    for package in re.findall(r"^==== Debian (\S+)", notice, re.MULTILINE):
        yield debian(package, "/var/lib/dpkg")
    if "==== Zstandard" in notice:
        version = re.findall(r"define ZSTD_VERSION_(?:MAJOR|MINOR|RELEASE) +(\d+)", ZSTD.read_text()) if ZSTD.exists() else []
        yield {"name": "zstd", "licenseDeclared": "BSD-3-Clause", "sourceInfo": "deps/zstd of the npm package zstd-napi",
               **({"versionInfo": ".".join(version)} if version else {})}
    if "The PlayCanvas engine" in notice:
        yield npm("playcanvas")


def page():
    return [npm("@roofgs/viewer"), *noticed((ROOT / "web/viewer/NOTICE").read_text())]


def field(deb, name):
    return subprocess.run(["dpkg-deb", "-f", deb, name], check=True, capture_output=True, text=True).stdout.strip()


def contents(path, own):
    """(relationship, package) for each that `path` holds or needs; `own` are the release's Debian packages by name."""
    if path.suffix == ".deb":
        for need in filter(None, (each.strip() for each in field(path, "Depends").split(","))):
            name = re.split(r"[ :(|]", need)[0]
            yield "DEPENDS_ON", own.get(name) or debian(name, "/var/lib/dpkg")
        if "viewer/single.html" in subprocess.run(["dpkg-deb", "-c", path], check=True, capture_output=True, text=True).stdout:
            yield from (("CONTAINS", package) for package in page())
        return
    if not path.name.endswith((".tar.gz", ".tgz", ".whl", ".zip")) or path.name.endswith("-site.tar.gz"):
        return
    inside = members(path)
    roots = sorted((ROOT / "build/roots").glob("arm64-*/var/lib/dpkg"), key=os.path.getmtime)
    status = roots[-1] if "arm64" in path.name and roots else "/var/lib/dpkg"
    for name, data in sorted(inside.items()):
        if (match := re.search(r"/licenses/([^/]+)$", name)) and match[1].lower() != "roofgs":
            yield "CONTAINS", debian(match[1], status, data)
        if path.suffix == ".tgz" and name == "package/NOTICE":
            yield from (("CONTAINS", package) for package in noticed(data.decode()))
        if path.suffix == ".tgz" and name == "package/package.json":
            for package in (more := json.loads(data)).get("dependencies", {}) | more.get("peerDependencies", {}):
                yield "DEPENDS_ON", npm(package)
        if name.endswith(".dist-info/METADATA"):
            for package in re.findall(r"^Requires-Dist: ([\w.-]+)", data.decode(), re.MULTILINE):
                yield "DEPENDS_ON", {"name": package}
        if name.endswith(("viewer/single.html", "/viewer.html")):
            yield from (("CONTAINS", package) for package in page())


def document(folder, version):
    epoch = int(os.environ.get("SOURCE_DATE_EPOCH", 0))
    packages, relationships = {}, []

    def identified(package):
        """Its SPDXID; the same name in the same version is one package."""
        key = re.sub(r"[^A-Za-z0-9.-]", "-", "-".join(filter(None, (package["name"], package.get("versionInfo")))))
        # What replaced characters make equal differs by its hash.
        digest = hashlib.sha256(repr((package["name"], package.get("versionInfo"))).encode()).hexdigest()[:8]
        spdx_id = f"SPDXRef-{key}-{digest}"
        # What one place does not say of it, another may.
        packages.setdefault(spdx_id, {}).update(package)
        return spdx_id

    def related(one, kind, other):
        relation = {"spdxElementId": one, "relationshipType": kind, "relatedSpdxElement": other}
        if relation not in relationships:
            relationships.append(relation)

    own_debs = {field(path, "Package"): {"name": path.name, "versionInfo": version} for path in folder.glob("*.deb")}
    hashes = hashlib.sha256()
    for path in sorted(path for path in folder.iterdir() if path.is_file()):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        hashes.update(f"{digest} {path.name}\n".encode())
        own = identified({"name": path.name, "versionInfo": version, "packageFileName": path.name, "licenseDeclared": "Apache-2.0",
                          "checksums": [{"algorithm": "SHA256", "checksumValue": digest}]})
        related("SPDXRef-DOCUMENT", "DESCRIBES", own)
        for kind, package in contents(path, own_debs):
            related(own, kind, identified(package))
    return {
        "spdxVersion": "SPDX-2.3",
        "dataLicense": "CC0-1.0",
        "SPDXID": "SPDXRef-DOCUMENT",
        "name": f"roofgs-{version}",
        "documentNamespace": f"https://roofgs.invalid/sbom/{version}/{hashes.hexdigest()}",
        "creationInfo": {"created": f"{datetime.datetime.fromtimestamp(epoch, datetime.timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
                         "creators": ["Tool: roofgs-sbom.py"]},
        "packages": [{"SPDXID": name, "downloadLocation": "NOASSERTION", "filesAnalyzed": False, **package}
                     for name, package in sorted(packages.items())],
        "relationships": relationships,
    }


if __name__ == "__main__":
    if len(sys.argv) != 3 or not Path(sys.argv[1]).is_dir():
        print("usage: sbom.py FOLDER VERSION", file=sys.stderr)
        sys.exit(2)
    print(json.dumps(document(Path(sys.argv[1]), sys.argv[2]), indent=1))
