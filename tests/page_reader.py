"""Reader of report.html for the tests of commands."""

from html.parser import HTMLParser

LARGEST = 3_000_000
VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Reader of a page: its tags must nest, and its links are collected."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.images = [], [], []
        self.cells, self.headings, self.alarms, self.captions = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.links += [found[key] for key in ("src", "href") if key in found]
        if tag == "img":
            self.images.append(found)
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        where = self.open[-1] if self.open else ""
        if where in ("td", "th"):
            self.cells[-1] += data
        if where in ("h1", "h2", "summary"):
            self.headings.append(data)
        if where == "caption":
            self.captions.append(data)
        if data.startswith("ALARM:"):
            self.alarms.append(data)


def checked(path):
    """Check that a page needs no file and no script; return what it holds."""
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST
    found = Reader(text)
    assert all(link.startswith("data:image/png;base64,") for link in found.links)
    assert all(image["alt"] for image in found.images)
    assert len(found.images) == len(list(path.parent.glob("*.png")))
    return found
