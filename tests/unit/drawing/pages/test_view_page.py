"""The page is complete in one file, and nothing in it is there because of a name."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace
from importlib.resources import files

import pytest
import scenes
from page_policy import check_policy

from gsmerge.drawing.pages.data import ViewData, collect_page_data
from gsmerge.drawing.pages.page import headline, results_table, speed, speed_words, view_page
from gsmerge.io.formats.rows import ExpectedScores
from gsmerge.scoring.evaluate import Quality

EVIL = '</script><b onload="x">&{{ 7 * 7 }}'
WEBP, PNG = "data:image/webp;base64,", "data:image/png;base64,"
NAMES = ("images/<i>0</i>.png", "images/1.png", EVIL)


def make_data() -> ViewData:
    scene = replace(scenes.make_scene(scenes.room(), scenes.arc(3)), names=NAMES)
    return collect_page_data(EVIL, scene, {EVIL: scene.gaussians[::2]}, (2_000_000, 1000))


@pytest.fixture(scope="module")
def data() -> ViewData:
    return make_data()


def page_of(data: ViewData) -> str:
    return view_page(data).decode()


@pytest.fixture(scope="module")
def page() -> str:
    return page_of(make_data())


def block(page: str, name: str) -> str:
    found = re.search(rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', page, re.DOTALL)
    return found[1]


def test_page_loads_nothing_from_outside(page: str) -> None:
    addresses = re.findall(r"""(?:src|href)=["']([^"']+)["']|url\(([^)]+)\)""", _written(page))
    assert len(addresses) >= 3
    assert all(one.startswith(("data:", '"${')) for pair in addresses for one in pair if one)
    assert re.findall(r"https?:|[\"']//", _written(page)) == []
    assert "Content-Security-Policy" in page
    assert "default-src &#x27;none&#x27;" in page


def test_policy_lets_the_page_s_own_scripts_and_styles_run_alone(page: str) -> None:
    """The policy names them by their hashes, and nothing needs more: no attribute holds a style or a script."""
    check_policy(page)


def _written(page: str) -> str:
    """Return the page without what is in base64: pictures and programs."""
    return re.sub(r'(<script type="text/plain" id="[\w-]+">)[^<]*', r"\1", re.sub(r"base64,[\w+/=]+", "base64,", page))


def test_names_in_the_page_are_escaped(page: str) -> None:
    text = _written(page)
    assert "<b onload" not in text
    assert "<i>" not in text
    assert text.count("&lt;/script&gt;&lt;b onload=&#34;x&#34;&gt;&amp;{{ 7 * 7 }}") >= 3
    assert text.count("<script") == text.count("</script>")


def test_page_holds_the_data_that_its_script_reads(page: str, data: ViewData) -> None:
    read = json.loads(block(page, "data"))
    assert [source["name"] for source in read["sources"]] == ["photo", "input", EVIL]
    assert [view["name"] for view in read["views"]] == [view.name for view in data.shown]
    first = read["views"][0]
    assert len(first["viewmat"]) == 16
    assert (first["width"], first["height"]) == (data.views[0].camera.width, data.views[0].camera.height)
    stills = json.loads(block(page, "stills"))
    assert read["start"] == data.start == 1
    assert stills[1][1:] == [None, None]  # those are in the page itself
    assert all(None not in stills[view] for view in (0, 2))
    shown = re.findall(r'<img id="(?:left|right)"[^>]* src="([^"]*)"', page)
    for address, still in ((shown[0], 1), (shown[1], 0)):
        assert base64.b64decode(address.removeprefix(WEBP)) == data.views[1].stills[still]
    assert base64.b64decode(stills[0][2].removeprefix(WEBP)) == data.views[0].stills[1]
    assert page.index("data:image/webp") < page.index("<script")
    for i, side in enumerate(data.sides):
        assert base64.b64decode(block(page, f"splats-{i}")) == side.splats
    assert b"SparkRenderer" in gzip.decompress(base64.b64decode(block(page, "engine")))


def with_three_results(data: ViewData) -> ViewData:
    """Return the scene with results of a half, a tenth and a hundredth; the second is worse than it."""
    scene, half = (replace(side, num_gaussians=1000, mean=Quality(20.0, 0.5)) for side in data.sides)
    half = replace(half, name="half", num_gaussians=500, file_bytes=2_000, mean=Quality(25.0, 0.75))
    tenth = replace(half, name="tenth", num_gaussians=100, file_bytes=400, mean=Quality(19.0, 0.5, lpips_alex=0.25))
    return replace(data, sides=(scene, half, tenth, replace(tenth, name="least", num_gaussians=10)))


def test_page_has_a_table_of_all_results(data: ViewData) -> None:
    three = with_three_results(data)
    head, rows = results_table(three)
    assert head == ["", "File", "PSNR (dB)", "SSIM", "LPIPS", "Gaussians", "Share"]
    assert rows[0] == ["input", "2.0 MB", "20.00", "0.500", "-", "1,000", "100.0 %"]
    assert rows[1] == ["half", "2.0 kB", "25.00", "0.750", "-", "500", "50.0 %"]
    assert [row[:1] + row[5:7] + row[4:5] for row in rows[2:]] == [
        ["tenth", "100", "10.0 %", "0.250"],
        ["least", "10", "1.0 %", "0.250"],
    ]
    page = page_of(three)
    assert re.findall(r'<tr data-result="(\d)">', page) == ["2", "3", "4"]
    assert page.count('<button class="link"') == 3


def test_each_result_has_its_headline_and_figures(data: ViewData) -> None:
    page = page_of(replace(with_three_results(data), reference="renders of the input"))
    half, tenth, least = json.loads(block(page, "data"))["results"]
    assert half["figures"] == [["500", ""], ["2.0 kB", ""], ["25.00 dB", "up"], ["0.750", "up"]]
    assert "No photo was held out" not in page
    assert tenth["figures"][2:] == [["19.00 dB", ""], ["0.500", ""]]
    assert [one["headline"].split("\u00a0")[0] for one in (half, tenth, least)] == ["50.0", "10.0", "1.0"]
    assert "farther" in tenth["headline"]
    assert '<select id="result"' not in page


def test_gain_of_new_views_comes_before_scores_of_own_photos(data: ViewData) -> None:
    three = with_three_results(data)
    gains = (None, ExpectedScores(20, 23.2, 1.5, 4.5), ExpectedScores(20, 19.8, -1.2, 0.8), None)
    sides = tuple(replace(side, new_views=gain) for side, gain in zip(three.sides, gains, strict=True))
    page = page_of(replace(three, sides=sides))
    half, tenth, least = json.loads(block(page, "data"))["results"]
    assert "new views +1.5 to +4.5 dB" in half["headline"].replace("\u00a0", " ")
    assert half["figures"][2:] == [["+1.5 to +4.5 dB", "up"], ["25.00 dB", "own"]]
    assert tenth["figures"][2] == ["-1.2 to +0.8 dB", ""]
    assert least["figures"][2] == ["-", ""]
    assert "No photo was held out: scores are those of photos that fits have seen." in page


def test_slider_chooses_among_sizes(data: ViewData) -> None:
    """From the smallest to the largest; it begins at the first result, and one result has none."""
    page = page_of(with_three_results(data))
    read = json.loads(block(page, "data"))
    assert read["sizes"] == [4, 3, 2]
    assert [one["words"] for one in read["results"]] == [
        "50.0\u00a0% · 2.0 kB · 25.0\u00a0dB", "10.0\u00a0% · 400 B · 19.0\u00a0dB", "1.0\u00a0% · 400 B · 19.0\u00a0dB"
    ]  # fmt: skip
    assert re.findall('<input id="size"[^>]* max="(.)" value="(.)">', page) == [("2", "2")]
    assert '<input id="size"' not in page_of(data)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (0.27, 0.03, ", about 9\u00a0\u00d7\u00a0faster to draw"),
        (0.35, 0.03, ", about 10\u00a0\u00d7\u00a0faster to draw"),
        (0.03, 0.02, ", 1.5\u00a0\u00d7\u00a0faster to draw"),
        (0.03, 0.03, ""),
    ],
)
def test_headline_says_how_much_faster_a_result_draws(before: float, after: float, words: str, data: ViewData) -> None:
    timed = replace(
        data, sides=tuple(replace(side, seconds=one) for side, one in zip(data.sides, (before, after), strict=True))
    )
    assert speed_words(speed(timed)) == words
    assert f">{words}</span></h1>" in page_of(timed)
    assert speed(replace(data, sides=data.sides[:1])) is None


def test_colours_are_readable_in_both_schemes(page: str) -> None:
    """Contrast of at least 4.5 of text on what it stands on."""
    style = re.findall("<style>(.*?)</style>", page, re.DOTALL)[0]
    light = dict(re.findall(r"--([\w-]+): (#\w+)", style.split(".top")[0].split("prefers-color-scheme")[0]))
    dark = light | dict(re.findall(r"--([\w-]+): (#\w+)", re.findall(r":root\.dark \{(.*?)\}", style)[0]))
    pairs = [(ink, ground) for ink in ("ink", "muted", "ours", "baseline", "good") for ground in ("page", "soft")]
    pairs += [("held-ink", "held"), ("worst-ink", "worst"), ("page", "ink")]
    for colors in (light, dark):
        assert [pair for pair in pairs if contrast(*(colors[name] for name in pair)) < 4.5] == []
    assert dark["page"] != light["page"]


def contrast(*colors: str) -> float:
    """Return the ratio of two colours' luminances, as WCAG 2 has it."""

    def luminance(color: str) -> float:
        digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
        values = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
        linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in values]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted(map(luminance, colors))
    return (high + 0.05) / (low + 0.05)


def test_scores_of_covered_pixels_stand_beside_those_of_all_pixels(data: ViewData) -> None:
    """Where the scene itself lacks pixels."""
    before, after = (replace(side, covered_share=0.79, covered=Quality(26.1)) for side in data.sides[:2])
    lacking = replace(data, sides=(before, after, *data.sides[2:]))
    assert "79 %" in page_of(replace(lacking, lacks_pixels=True))
    assert "79 %" not in page_of(lacking)


def test_the_view_from_outside_has_neither_photo_nor_score(page: str, data: ViewData) -> None:
    *views, outside = json.loads(block(page, "data"))["views"]
    assert [view["outside"] for view in views] == [False] * len(data.views)
    assert (outside["outside"], outside["held_out"], outside["scores"]) == (True, False, [])
    photo, *renders = json.loads(block(page, "stills"))[-1]
    assert photo is None
    assert [base64.b64decode(one.removeprefix(WEBP)) for one in renders] == list(data.outside.stills)
    cards = re.findall('<button class="card".*?</button>', page, re.DOTALL)
    assert ["from outside" in card for card in cards] == [False] * len(data.views) + [True]
    assert ["dB" in card for card in cards] == [True] * len(data.views) + [False]


def test_without_gaussians_there_is_no_3d(data: ViewData) -> None:
    page = page_of(replace(data, sides=tuple(replace(side, splats=None) for side in data.sides)))
    assert 'id="engine"' not in page
    assert "class SplatView" not in page
    assert len(page) < 200_000


def test_page_without_photos_offers_no_photo_to_compare(data: ViewData) -> None:
    page = page_of(replace(data, views=tuple(replace(view, photo=None) for view in data.views)))
    assert [source["name"] for source in json.loads(block(page, "data"))["sources"]] == ["input", EVIL]
    assert "overlay-share" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


@pytest.fixture(scope="module")
def alone() -> ViewData:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))
    return collect_page_data("room", scene, {}, (2_000_000,))


def test_one_scene_is_compared_with_its_photos(alone: ViewData) -> None:
    page = page_of(alone)
    read = json.loads(block(page, "data"))
    assert [source["name"] for source in read["sources"]] == ["photo", "input"]
    assert headline(alone).replace(" dB", "\u00a0dB") in page
    assert re.findall('<option value="(.)" selected>(.*?)<', page) == [("0", "photo"), ("1", "input")]
    assert "<span>→" not in page
    check_policy(page)


def test_one_scene_without_photos_is_compared_with_nothing(alone: ViewData) -> None:
    views = tuple(replace(view, photo=None) for view in alone.views)
    data = replace(alone, views=views)
    page = page_of(data)
    assert (data.scored, data.start) == (False, 0)
    assert json.loads(block(page, "stills"))[0] == [None]
    seen = re.sub("<script.*?</script>", "", page, flags=re.DOTALL)
    assert [words for words in ("PSNR</small>", 'data-set="mode"', "Worst first", "PSNR and") if words in seen] == []
    assert page_of(alone).count('data-set="mode"') == 4


def test_unpaired_surrogates_in_names_become_question_marks(data: ViewData) -> None:
    assert "odd?" in page_of(replace(data, title="odd\udcff"))


def test_page_has_the_vendored_renderer() -> None:
    """Who changes it runs tools/vendor_viewer.py, which writes down where it came from."""
    vendor = files("gsmerge.drawing.pages").joinpath("vendor")
    sources = json.loads(vendor.joinpath("SOURCES.json").read_text())
    script = gzip.decompress(vendor.joinpath(sources["script"]["file"]).read_bytes())
    assert hashlib.sha256(script).hexdigest() == sources["script"]["sha256"]
    assert len(script) == sources["script"]["bytes"]
    assert set(sources["packages"]) >= {"@sparkjsdev/spark", "three"}
    for package in ("spark", "three", "fflate"):
        assert "MIT" in vendor.joinpath(f"LICENSE.{package}").read_text()
