"""report.html in a real browser: it fetches nothing, reports no error, prints whole."""

import base64
import io
import json
import shutil
import unicodedata

import pytest
from page_reader import LARGEST
from small_runs import COLUMNS, STUDY, call, succeeded, write_record, write_study

import piezojax as pj
from piezojax.report.page import Page, write_page

CHROMIUM, DRIVER = (shutil.which(name) for name in ("chromium", "chromedriver"))
if CHROMIUM is None or DRIVER is None:
    pytest.skip("chromium and chromedriver are not installed", allow_module_level=True)
NEEDS = "pip install -e '.[browser]'"
webdriver = pytest.importorskip("selenium.webdriver", reason=NEEDS)
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
    succeeded(call("tune", study, "--out", out["tune"]))
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
    assert page.get_log("browser") == []
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
