"""report.html in a real browser: it fetches nothing, reports no error, prints whole."""

import base64
import io
import json
import re
import shutil
import unicodedata

import pytest
from page_reader import LARGEST
from small_runs import COLUMNS, STUDY, call, succeeded, write_record, write_study

import piezojax as pj
from piezojax.core.paths import replace
from piezojax.report.page import Page, write_page
from piezojax.study import read
from piezojax.tuning.data import make_data
from piezojax.tuning.runs import evaluate

CHROMIUM, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))
if CHROMIUM is None or DRIVER is None:
    pytest.skip("chromium and chromedriver are not installed", allow_module_level=True)
NEEDS = "pip install -e '.[browser]'"
webdriver = pytest.importorskip("selenium.webdriver", reason=NEEDS)
WebDriverWait = pytest.importorskip("selenium.webdriver.support.ui").WebDriverWait
pypdf = pytest.importorskip("pypdf", reason=NEEDS)

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--window-size=1200,1000"),
)
SWEEP = {
    "metrics": ["rms_error"],
    "parameters": {"controller.proportional": {"lower": 0.5, "upper": 2.0, "count": 3}},
}
ALARM = "the loop rings & rails"
KINDS = ("tune", "identify", "sweep", "export", "alarm")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return the folders of results by command, and one of a page with an alarm."""
    here = tmp_path_factory.mktemp("pages")
    out = {kind: here / kind for kind in KINDS}
    study, swept = write_study(here), write_study(here, "swept.toml", sweep=SWEEP)
    parts = ("--train", "0:200", "--validate", "220:300", "--model", "coleman_hodgdon")
    record = write_record(here)
    succeeded(call("tune", study, "--sliders", "--out", out["tune"]))
    succeeded(call("identify", record, *COLUMNS, *parts, "--out", out["identify"]))
    succeeded(call("sweep", swept, "--out", out["sweep"]))
    succeeded(call("export", out["tune"], "--out", out["export"]))
    out["alarm"].mkdir()
    write_page(Page("gains of a stage", [ALARM], ["a note"]), out["alarm"])
    return out


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    logged = {"browser": "ALL", "performance": "ALL"}
    options.set_capability("goog:loggingPrefs", logged)
    service = webdriver.ChromeService(executable_path=DRIVER)
    with webdriver.Chrome(options=options, service=service) as driver:
        yield driver


@pytest.fixture(params=KINDS)
def page(request, browser, folders):
    """Return the browser with a page open; reading a log empties it."""
    browser.get("about:blank")
    for log in ("browser", "performance"):
        browser.get_log(log)
    browser.get((folders[request.param] / "report.html").as_uri())
    return browser


def requested(browser):
    """Return the addresses that the page asked for."""
    events = (json.loads(e["message"]) for e in browser.get_log("performance"))
    return [
        event["message"]["params"]["request"]["url"]
        for event in events
        if event["message"]["method"] == "Network.requestWillBeSent"
    ]


def printed(browser):
    """Return the text of the page on paper, as ``letters``."""
    pdf = browser.execute_cdp_cmd("Page.printToPDF", {})
    sheets = pypdf.PdfReader(io.BytesIO(base64.b64decode(pdf["data"]))).pages
    return letters("".join(sheet.extract_text() for sheet in sheets))


def letters(text):
    """Return ``text`` without spaces, as lines may break, and without ligatures."""
    return "".join(unicodedata.normalize("NFKC", text).split())


def texts(browser, selector):
    """Return the text of every element, also of those that are not displayed."""
    script = (
        "return [...document.querySelectorAll(arguments[0])].map(e => e.textContent)"
    )
    return browser.execute_script(script, selector)


def test_a_page_stands_alone(page, folders):
    logged = page.get_log("browser")
    assert [entry for entry in logged if entry["level"] != "INFO"] == []
    own, *others = requested(page)
    assert own == page.current_url
    assert [url for url in others if not url.startswith("data:")] == []


def test_a_page_is_small_and_its_pictures_are_described(page, folders):
    [path] = [f / "report.html" for f in folders.values() if f.name in page.current_url]
    assert path.stat().st_size < LARGEST
    images = page.execute_script(
        "return [...document.images].map(i => [i.alt, i.naturalWidth])"
    )
    assert len(images) == len(list(path.parent.glob("*.png")))
    assert all(alt and width > 100 for alt, width in images)


def test_nothing_is_lost_on_paper(page):
    paper = printed(page)
    for selector in ("h1", "h2", ".alarm", "caption", "td", "th", "li", "pre"):
        for text in texts(page, selector):
            assert letters(text) in paper, f"{selector}: {text}"


def test_nothing_is_cut_off_on_paper(page):
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    cut = page.execute_script(
        "return [...document.body.querySelectorAll(':not(img)')].filter(e => "
        "getComputedStyle(e).overflowX !== 'visible').map(e => e.outerHTML)"
    )
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert cut == []


def test_an_alarm_is_on_paper(browser, folders):
    browser.get((folders["alarm"] / "report.html").as_uri())
    assert letters(f"ALARM: {ALARM}") in printed(browser)


def test_the_study_is_on_paper(browser, folders):
    browser.get((folders["tune"] / "report.html").as_uri())
    assert letters(f'title = "{STUDY["title"]}"') in printed(browser)


def test_the_tables_hold_the_figures_of_the_result(browser, folders):
    browser.get((folders["tune"] / "report.html").as_uri())
    cells, result = texts(browser, "td"), pj.load_result(folders["tune"])
    for path, value in result.gains.items():
        row = cells.index(path.removeprefix("controller."))
        assert float(cells[row + 2]) == pytest.approx(value, rel=1e-3)
    for name, rms in result.holdout.per_reference_rms_um.items():
        row = cells.index(name)
        assert float(cells[row + 2]) == pytest.approx(1e3 * rms, abs=0.006)


# Interactive figures


@pytest.fixture
def tuned(browser, folders):
    """Return the browser with the page of tune, its figures drawn."""
    browser.get((folders["tune"] / "report.html").as_uri())
    drawn = "return [...document.querySelectorAll('.live')].every(e => e.firstChild)"
    WebDriverWait(browser, 10).until(lambda b: b.execute_script(drawn))
    return browser


def displayed(browser):
    """Return the numbers of the displayed interactive figures and of the images."""
    script = """
        const shown = e => getComputedStyle(e).display !== 'none' && e.offsetHeight > 0
        return ['.live', '.live + img', 'img'].map(
            s => [...document.querySelectorAll(s)].filter(shown).length)
    """
    return browser.execute_script(script)


FRAME = """
    const panel = Bokeh.documents[0].roots()[0].children[arguments[0]][0]
    const view = Bokeh.index.find_one(panel)
    view.el.scrollIntoView({block: "center"})
    const inner = view.frame.bbox, outer = view.el.getBoundingClientRect()
    return [outer.left + inner.left, outer.top + inner.top, inner.width, inner.height]
"""
RANGE = """
    const range = Bokeh.documents[0].roots()[0].children[arguments[0]][0].x_range
    return [range.start, range.end]
"""
READINGS = """
    const text = root => [...root.querySelectorAll('div:not(:has(div))')]
        .map(e => e.textContent).join('')
    const found = node => [...node.querySelectorAll('*')].flatMap(e => [
        ...(e.matches('.bk-Tooltip') ? [text(e.shadowRoot)] : []),
        ...(e.shadowRoot ? found(e.shadowRoot) : [])])
    return found(document)
"""


def at(browser, panel, across, down, kind="mouseMoved", **more):
    """Send a movement or a button of the mouse to a place in a panel of tracking."""
    left, top, width, height = browser.execute_script(FRAME, panel)
    place = {"x": left + across * width, "y": top + down * height}
    event = {"type": kind, **place, **more}
    browser.execute_cdp_cmd("Input.dispatchMouseEvent", event)


def test_curves_are_interactive_on_a_screen_and_pictures_on_paper(tuned, folders):
    live, beside, images = displayed(tuned)
    curves = ("tracking", "steps", "stability", "hysteresis", "convergence")
    assert live == len(curves) + 1  # the sliders
    assert beside == 0
    assert images > 0  # of other pictures
    tuned.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert displayed(tuned) == [0, len(curves), len(curves) + images]
    tuned.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    tuned.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    tuned.refresh()
    assert displayed(tuned) == [0, len(curves), len(curves) + images]
    tuned.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


def test_a_curve_can_be_read(tuned, folders):
    for step in (0.5, 0.501):
        at(tuned, 1, step, 0.5)
    WebDriverWait(tuned, 5).until(lambda b: len(b.execute_script(READINGS)) == 2)
    before, after = tuned.execute_script(READINGS)
    result = pj.load_result(folders["tune"])
    rms = 1e3 * result.holdout.per_reference_rms_um["SIN50"]
    assert before.startswith("before, ")
    name, peak = f"tuned, {rms:.4g} nm rms", 1e3 * result.holdout.peak_error_um["SIN50"]
    found = re.fullmatch(rf"{name}:\s*(\S+) nm at (\S+) s", after.strip())
    assert abs(float(found[1])) <= peak
    assert float(found[2]) == pytest.approx(0.035, abs=1e-3)  # between 0.02 and 0.05 s


def test_a_rectangle_is_enlarged_in_all_panels_of_a_row(tuned):
    whole = tuned.execute_script(RANGE, 0)
    button = {"button": "left", "buttons": 1, "clickCount": 1}
    at(tuned, 1, 0.4, 0.3)
    at(tuned, 1, 0.4, 0.3, "mousePressed", **button)
    at(tuned, 1, 0.5, 0.5, **button)
    at(tuned, 1, 0.6, 0.7, **button)
    at(tuned, 1, 0.6, 0.7, "mouseReleased", **button)
    width = whole[1] - whole[0]
    expected = [whole[0] + share * width for share in (0.4, 0.6)]
    for panel in (0, 1):
        found = tuned.execute_script(RANGE, panel)
        assert found == pytest.approx(expected, abs=0.01 * width)


# Sliders

MOVE = """
    const models = [...Bokeh.documents[0]._all_models.values()]
    const sliders = models.filter(model => model.type == "Slider")
    sliders.forEach((slider, index) => { slider.value = arguments[0][index] })
    const formats = sliders.map(slider => slider.format.compute(slider.value))
    const line = models.filter(model => model.name == "gains of the sliders")[0]
    return [formats, [...line.data_source.data.displacement]]
"""


def figures_of(browser):
    """Return tuned, moved and unit of each figure of the table of the sliders."""
    rows = browser.execute_script(
        """
        const found = node => [...node.querySelectorAll('*')].flatMap(
            e => [...(e.matches('tr') ? [e] : []),
                  ...(e.shadowRoot ? found(e.shadowRoot) : [])])
        const inside = document.querySelector('.note .live')
        return found(inside).map(row => [...row.children].map(e => e.textContent))
        """
    )
    return {row[0]: row[1:] for row in rows[1:]}


def test_sliders_start_at_the_tuned_gains(tuned, folders):
    result = pj.load_result(folders["tune"])
    found = figures_of(tuned)
    for name, rms in result.holdout.per_reference_rms_um.items():
        shown, moved, unit, _ = found[f"rms error under {name}"]
        assert shown == moved
        assert float(shown) == pytest.approx(1e3 * rms, rel=1e-3)
        assert unit == "nm"
    stability = json.loads((folders["tune"] / "stability.json").read_text())
    exact = max(b["sensitivity_peak"] for b in stability["after"].values())
    assert float(found["sensitivity peak"][0]) == pytest.approx(exact, rel=1e-2)


def test_moved_sliders_show_what_their_gains_give(tuned, folders):
    formats, step = tuned.execute_script(MOVE, [0.25, 0.5])
    gains = [float(text.split()[0]) for text in formats]
    result = pj.load_result(folders["tune"])
    assert [text.split(" ", 1)[1] for text in formats] == [*result.gain_units.values()]
    case = read(folders["tune"].parent / "small.toml")
    loop = replace(case.loop, dict(zip(case.space.paths, gains, strict=True)))
    found = figures_of(tuned)
    signals = make_data(case).holdout
    errors = evaluate(lambda loop: loop, loop, signals, case.study.settled).rms_error
    for name, rms in zip(("SIN50", "SW50"), errors, strict=True):
        shown, moved, _, doubt = found[f"rms error under {name}"]
        share = float(doubt.removesuffix(" %")) / 100.0
        assert share < 0.02
        assert float(moved) == pytest.approx(1e3 * float(rms[0]), rel=2 * share + 1e-3)
        assert shown != moved
    report = pj.stability_report(loop, case.margin_reference)
    for name, value in (
        ("sensitivity peak", report.sensitivity_peak),
        ("gain margin", report.gain_margin_dB),
        ("phase margin", report.phase_margin_deg),
        ("delay margin", report.delay_margin_samples),
    ):
        assert float(found[name][1]) == pytest.approx(value, rel=1e-2), name
    assert len(step) > 100
