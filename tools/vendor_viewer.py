"""Make gsmerge/drawing/pages/vendor: Spark and three.js in one compressed file, licences, and a record of sources.

python tools/vendor_viewer.py

This is needed only to change a version. It runs on Linux x86-64. It needs npm, which fetches five packages, and Node,
which runs one of them. Equal versions give equal bytes, and a test compares the content with its hash in SOURCES.json.

The file holds the script, a zero byte, and Spark's WebAssembly without the functions that our pages never call. Spark
has the WebAssembly as base64 text in the script, which compresses badly.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import subprocess
import tarfile
import tempfile
from pathlib import Path

VENDOR = Path(__file__).parents[1] / "gsmerge" / "drawing" / "pages" / "vendor"
SCRIPT = "spark-three.js.gz"
# Version and hash of each npm package; `npm view PACKAGE dist.integrity` prints the hash
PACKAGES = {
    "@sparkjsdev/spark": (
        "2.2.0",
        "sha512-wf5F2YAmPXnjm20/MgXYer9FQTXz2JOCo05HwxFkaD7Guk9rHVPIwdJ6fq0oF9ME0heMvYj+TxS6DTrucvy6KA==",
    ),
    "three": (
        "0.187.0",
        "sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
    ),
    "fflate": (  # a part of Spark
        "0.8.3",
        "sha512-tbZNuJrLwGUp3zshBtdy4W+ORxZuIh8a5ilyIEQDC5rY1f3U20JMry0Ll3WBzU58EZKsEuJFXhb5gwv8CsPvgA==",
    ),
    "@esbuild/linux-x64": (
        "0.28.2",
        "sha512-4xTZr1FUmSoQW4XIWmit3tzQrUTZM+N3P0XV8xROKYF50XfI7xeO90+1bZvNwxIufQ9hDQVRJH5YhgPVF8A/HQ==",
    ),
    "binaryen": (
        "132.0.0",
        "sha512-4Usg7yEvwO3FMso3Oov6qkOOHSod1IEv+boKkh77kTljM+eNBouqCTbqWswGzbG+vDNO/b/v2C4gfEh1WgB9Lg==",
    ),
}
LICENCES = {"@sparkjsdev/spark": "LICENSE.spark", "three": "LICENSE.three", "fflate": "LICENSE.fflate"}
# Names of Spark and three.js that the pages' own scripts use
ENTRY = """
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
export {
  BufferAttribute, BufferGeometry, FramebufferTexture, LineSegments, Matrix4, Mesh, PerspectiveCamera, PlaneGeometry,
  Points, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from "three";
"""
# Functions of Spark's WebAssembly that are called to decode a file and to sort Gaussians
CALLED = [
    "memory",
    "__externref_table_alloc",
    "__externref_table_dealloc",
    "__wbg_chunkdecoder_free",
    "__wbindgen_exn_store",
    "__wbindgen_externrefs",
    "__wbindgen_free",
    "__wbindgen_malloc",
    "__wbindgen_realloc",
    "__wbindgen_start",
    "chunkdecoder_finish",
    "chunkdecoder_push",
    "decode_to_packedsplats",
    "simd_enabled",
    "sort32_splats",
    "sort_splats",
    "wasm_start",
]
MODULE = rb'\w+\("([A-Za-z0-9+/=]{100000,})"\)(?=\.buffer)'  # the bytes of the WebAssembly


def main() -> None:
    """Fetch and check the packages, bundle the script, cut the WebAssembly, and write all files."""
    with tempfile.TemporaryDirectory() as work:
        modules = Path(work) / "node_modules"
        for package in PACKAGES:
            unpack(fetch(package, Path(work)), modules / package)
        entry, bundle = Path(work) / "entry.js", Path(work) / "bundle.js"
        entry.write_text(ENTRY, encoding="utf-8")
        esbuild = modules / "@esbuild" / "linux-x64" / "bin" / "esbuild"
        options = ("--bundle", "--minify", "--format=iife", "--global-name=Vendor", "--legal-comments=none")
        subprocess.run([esbuild, entry, *options, f"--outfile={bundle}"], cwd=work, check=True)
        script = bundle.read_bytes()
        (match,) = re.finditer(MODULE, script)
        module = cut_module(base64.b64decode(match[1]), modules / "binaryen" / "bin" / "wasm-metadce", Path(work))
        script = b"".join([script[: match.start()], b"window.sparkModule", script[match.end() :], b"\0", module])
        VENDOR.mkdir(parents=True, exist_ok=True)
        VENDOR.joinpath(SCRIPT).write_bytes(gzip.compress(script, 9, mtime=0))
        for package, name in LICENCES.items():
            VENDOR.joinpath(name).write_bytes(modules.joinpath(package, "LICENSE").read_bytes())
    sources = {
        "made_by": f"tools/{Path(__file__).name}",
        "script": {"file": SCRIPT, "bytes": len(script), "sha256": hashlib.sha256(script).hexdigest()},
        "packages": {name: {"version": version, "integrity": sha} for name, (version, sha) in PACKAGES.items()},
    }
    VENDOR.joinpath("SOURCES.json").write_text(json.dumps(sources, indent=2) + "\n", encoding="utf-8")
    print(f"{VENDOR}: {len(script):,} bytes, {VENDOR.joinpath(SCRIPT).stat().st_size:,} compressed")


def cut_module(module: bytes, program: Path, work: Path) -> bytes:
    """Return a WebAssembly module without the functions that none of ``CALLED`` reaches."""
    whole, graph, cut = work / "whole.wasm", work / "graph.json", work / "cut.wasm"
    whole.write_bytes(module)
    root = {"name": "root", "reaches": CALLED, "root": True}
    graph.write_text(json.dumps([root, *({"name": name, "export": name} for name in CALLED)]), encoding="utf-8")
    options = ("--graph-file", graph, "-o", cut)
    subprocess.run(["node", program, whole, *options], check=True, stdout=subprocess.DEVNULL)
    return cut.read_bytes()


def fetch(package: str, folder: Path) -> Path:
    """Fetch the tarball of a package, check its hash, and return its path."""
    version, integrity = PACKAGES[package]
    call = ["npm", "pack", "--silent", "--ignore-scripts", f"{package}@{version}"]
    name = subprocess.run(call, cwd=folder, check=True, capture_output=True, text=True).stdout.split()[-1]
    digest = hashlib.sha512(folder.joinpath(name).read_bytes()).digest()
    if integrity != f"sha512-{base64.b64encode(digest).decode()}":
        raise SystemExit(f"{package}@{version}: expected {integrity}, got another file")
    return folder / name


def unpack(tarball: Path, folder: Path) -> None:
    """Extract the only folder of a tarball as ``folder``."""
    folder.mkdir(parents=True)
    with tarfile.open(tarball) as archive:
        for member in archive.getmembers():
            member.name = member.name.partition("/")[2]
            if member.isfile():
                archive.extract(member, folder, filter="data")


if __name__ == "__main__":
    main()
