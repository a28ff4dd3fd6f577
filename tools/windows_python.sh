#!/usr/bin/env bash
# Makes a CPython 3.11 for Windows that runs under Wine, with the packages that gsmerge and its tests need:
#   windows_python.sh FOLDER
# Then FOLDER/install WHEEL... adds wheels (or requirements), and FOLDER/python ARGUMENTS... runs it.
#
# It needs Debian's wine64 and wine, unzip, and a Python 3.11 with venv and pip. Everything else comes from package
# indexes, so a machine that reaches no other server can run it:
#   python311.dll, extension modules   are in the wheel of panda3d for Windows
#   modules of the standard library    are those of the Python 3.11 that runs here
#   python.exe, python3.dll            are compiled here by ziglang; python3.dll forwards to python311.dll
#   what Wine 8 lacks                  is compiled here: ProcessPrng (bcryptprimitives.dll), and crealf, cimagf, creal
#                                      and cimag, in a library from which NumPy then imports them
set -euo pipefail
[ $# -eq 1 ] || { sed -n '2,4s/^# *//p' "$0" >&2; exit 2; }
root=$(cd "$(dirname "$0")/.." && pwd)
for program in wine unzip python3.11; do
  command -v "$program" >/dev/null || { echo "expected the program $program, found none; see the head of $0" >&2; exit 1; }
done
mkdir -p "$1" && cd "$1"
mkdir -p py/DLLs py/Lib/site-packages wheels made

python3.11 -m venv tools
tools/bin/pip install -q pefile "$(grep -o 'ziglang==[0-9.]*' "$root/pyproject.toml" | head -1)"

# Install packages for Windows. Newer versions of some need more than Wine 8's C library has, see their bounds below
cat >install <<'SH'
#!/usr/bin/env bash
set -euo pipefail
home=$(cd "$(dirname "$0")" && pwd)
"$home/tools/bin/pip" install -q --upgrade --no-compile --target "$home/py/Lib/site-packages" --only-binary=:all: \
  --platform win_amd64 --python-version 3.11 --implementation cp "$@"
cd "$home" && tools/bin/python turn_imports.py
SH

cat >python <<'SH'
#!/usr/bin/env bash
# The streams of Wine's Python have to be pipes. PYTHONPATH and PYTHONHOME have paths that it does not know
set -o pipefail
home=$(cd "$(dirname "$0")" && pwd)
export WINEPREFIX="$home/prefix" WINEDEBUG=-all
unset PYTHONPATH PYTHONHOME
{ wine "$home/py/python.exe" "$@" </dev/null 2>&1 >&3 3>&- | cat >&2; } 3>&1 | cat
SH
chmod +x install python

# Let imports of the C library name our library, and write .def files of what our library and python3.dll export
cat >turn_imports.py <<'PY'
import pefile
from pathlib import Path

THEIRS, OURS = b"api-ms-win-crt-math-l1-1-0.dll", b"api-ms-win-crt-mat2-l1-1-0.dll"
MADE = {"crealf", "cimagf", "creal", "cimag"}
made = Path("made")


def write_exports(library, lines):
    (made / f"{library}.def").write_text(f"LIBRARY {library}\nEXPORTS\n" + "\n".join(lines) + "\n")


names = set()
for path in Path("py/Lib/site-packages").rglob("*"):
    if path.suffix in (".pyd", ".dll") and (THEIRS in (data := path.read_bytes()) or OURS in data):
        image = pefile.PE(data=data, fast_load=True)
        image.parse_data_directories([pefile.DIRECTORY_ENTRY["IMAGE_DIRECTORY_ENTRY_IMPORT"]])
        for library in getattr(image, "DIRECTORY_ENTRY_IMPORT", ()):
            if library.dll.lower() in (THEIRS, OURS):
                names |= {entry.name.decode() for entry in library.imports if entry.name}
        path.write_bytes(data.replace(THEIRS, OURS))
ours = OURS.decode().removesuffix(".dll")
write_exports(ours, [*MADE, *(f"{name}=ucrtbase.{name}" for name in sorted(names - MADE))])
exports = pefile.PE("py/python311.dll").DIRECTORY_ENTRY_EXPORT.symbols
write_exports("python3", [f"{entry.name.decode()}=python311.{entry.name.decode()}" for entry in exports if entry.name])
PY

tools/bin/pip download -q --no-deps --only-binary=:all: --platform win_amd64 --python-version 3.11 --implementation cp \
  -d wheels panda3d
unzip -q -o -j wheels/panda3d*.whl 'deploy_libs/*' -d made/panda3d
cp made/panda3d/*.dll py/ && cp made/panda3d/*.pyd py/DLLs/
library=$(python3.11 -c 'import os; print(os.path.dirname(os.__file__))')
tar -C "$library" --exclude=./dist-packages --exclude=./site-packages --exclude=./lib-dynload --exclude=./test \
  --exclude=__pycache__ -c . | tar -C py/Lib -x
requirements=$(tools/bin/python - "$root/pyproject.toml" <<'PY'
import sys, tomllib
project = tomllib.load(open(sys.argv[1], "rb"))["project"]
extras = project["optional-dependencies"]
print("\n".join(project["dependencies"]))
PY
)
mapfile -t requirements <<<"$requirements"
./install "${requirements[@]}" 'numpy<2.3' 'scipy<1.16' colorama pytest pytest-xdist hypothesis

cat >made/python.c <<'C'
#include <windows.h>
int wmain(int argc, wchar_t **argv) {
  HMODULE library = LoadLibraryW(L"python311.dll");
  int (*run)(int, wchar_t **) = library ? (void *)GetProcAddress(library, "Py_Main") : 0;
  return run ? run(argc, argv) : 99;
}
C
cat >made/prng.c <<'C'
#include <windows.h>
__declspec(dllexport) BOOL ProcessPrng(unsigned char *bytes, size_t count) {
  BOOLEAN(WINAPI * fill)(void *, ULONG) = (void *)GetProcAddress(LoadLibraryA("advapi32.dll"), "SystemFunction036");
  return fill(bytes, (ULONG)count);
}
C
entry='int _DllMainCRTStartup(void *a, unsigned b, void *c) { return 1; }'
echo "$entry" >made/python3.c
cat >made/math.c <<C
typedef struct { float r, i; } single;
typedef struct { double r, i; } pair;
int _fltused = 0;
float crealf(single z) { return z.r; }
float cimagf(single z) { return z.i; }
double creal(pair *z) { return z->r; }
double cimag(pair *z) { return z->i; }
$entry
C
zig() { tools/bin/python -m ziglang cc -target x86_64-windows-gnu -O1 "$@"; }
bare=(-shared -nostdlib -fno-builtin -Wl,--entry=_DllMainCRTStartup)
zig -municode -o py/python.exe made/python.c
zig -shared -o py/bcryptprimitives.dll made/prng.c
zig "${bare[@]}" -o py/python3.dll made/python3.c made/python3.def
zig "${bare[@]}" -o py/api-ms-win-crt-mat2-l1-1-0.dll made/math.c made/api-ms-win-crt-mat2-l1-1-0.def
./python -c "import sys, numpy; print('Python', sys.version.split()[0], 'on', sys.platform, 'with NumPy', numpy.__version__)"
