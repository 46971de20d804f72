"""What a reader sees of a page."""

from html.parser import HTMLParser


class Page(HTMLParser):
    """Collects what a page refers to and says."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.scripts, self.words, self._inside = [], [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._inside.append(tag)

    def handle_endtag(self, tag):
        if self._inside and tag == self._inside[-1]:
            self._inside.pop()

    def handle_data(self, data):
        if not self._inside:
            self.words.append(data)
        elif self._inside[-1] == "script":
            self.scripts.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())
