"""HTML pages, read and checked."""

from html.parser import HTMLParser

VOID = {"meta", "link", "img", "input", "br", "path", "rect", "circle"}


class Reader(HTMLParser):
    """Collects what a page consists of; fails where tags are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.headings = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert tag not in VOID and self.open and self.open.pop() == tag, tag

    def all(self, name):
        return [attributes for tag, attributes in self.tags if tag == name]
