"""Build the pages as a site with a search: build/site, from the pages that docs/zensical.toml names.

python docs/build_site.py                          # after python tasks.py setup, which installs what it needs
python -m http.server 8000 --directory build/site  # then look at http://localhost:8000

Pages and what they link to are copied to build/pages with the folders of the repository, so that a relative link leads
to the same file on the site and in the repository. What would be missing on the site ends the build: a page without a
place in the navigation, a link to a file or a heading that is not there.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"
SETTINGS = ROOT / "docs" / "zensical.toml"
UNSEARCHED = {"CHANGELOG.md"}  # has the words of all other pages
BADGES = re.compile(r"^\[!\[.*\n", re.MULTILINE)  # states of the repository, whose links lead to its host


def main() -> int:
    """Copy the pages, build them, and return the exit code: 1 if something is missing."""
    settings = SETTINGS.read_text(encoding="utf-8")
    missing = find_missing(settings)
    if find_spec("zensical") is None:
        missing.append("expected zensical, which python tasks.py setup installs")
    if missing:
        print("\n".join(missing))
        return 1
    for name in ("pages", "site", ".cache"):
        shutil.rmtree(BUILD / name, ignore_errors=True)
    pages = pages_of(settings)
    for file in sorted({*pages, "docs/site.css"}.union(*map(links_of, pages))):
        (BUILD / "pages" / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, BUILD / "pages" / file)
        if file.endswith(".md"):
            head = "---\nsearch:\n  exclude: true\n---\n\n" if file in UNSEARCHED else ""
            text = BADGES.sub("", (ROOT / file).read_text(encoding="utf-8"))
            (BUILD / "pages" / file).write_text(head + text, encoding="utf-8")
    (BUILD / "zensical.toml").write_text(settings.replace("[project]\n", f"[project]\n{_addresses()}", 1), "utf-8")
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--config-file", str(BUILD / "zensical.toml")]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def find_missing(settings: str) -> list[str]:
    """Return a line for each page without a place in the navigation, and for each link that the site would not have."""
    pages = pages_of(settings)
    written = [str(path.relative_to(ROOT).as_posix()) for path in (*ROOT.glob("*.md"), *SETTINGS.parent.rglob("*.md"))]
    lines = [f"{page}: expected a place in docs/zensical.toml" for page in sorted(set(written) - set(pages))]
    for page in pages:
        if not (ROOT / page).is_file():
            lines.append(f"docs/zensical.toml: {page} is not there")
            continue
        for file in sorted(links_of(page)):
            if not (ROOT / file).is_file():
                lines.append(f"{page}: expected a file at the end of a link, found {file}")
            elif file.endswith(".md") and file not in pages:
                lines.append(f"{page}: expected a place in docs/zensical.toml of {file}, to which it links")
    return lines


def pages_of(settings: str) -> list[str]:
    """Return the pages of the navigation, by their paths in the repository."""
    return re.findall(r'"(\S+\.md)"', settings)


def links_of(page: str) -> set[str]:
    """Return the paths in the repository of the files to which a page links, without addresses of other hosts."""
    text = BADGES.sub("", (ROOT / page).read_text(encoding="utf-8"))
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    paths = [target.partition("#")[0] for target in targets if "://" not in target]
    return {os.path.normpath(os.path.join(os.path.dirname(page), path)).replace(os.sep, "/") for path in paths if path}


def _addresses() -> str:
    """Return the lines with the addresses of the site and of the repository, as far as the environment has them."""
    repository = os.environ.get("GITHUB_REPOSITORY", "")
    lines = [f'site_url = "{os.environ["SITE_URL"].rstrip("/")}/"\n'] if os.environ.get("SITE_URL") else []
    lines += [f'repo_url = "https://github.com/{repository}"\n', f'repo_name = "{repository}"\n'] if repository else []
    return "".join(lines)


if __name__ == "__main__":
    sys.exit(main())
