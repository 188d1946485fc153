"""Paths, names and errors of others are shown as they are: nothing in them is markup, or a control character."""

from html.parser import HTMLParser

import pytest

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.literal import to_html, to_markdown
from mqe_jax.study.report import markdown

EVIL = "<script>x</script> <img src=x onerror=y> ![a](b) [c](d) `e` *f* __g__ ~~h~~ | &lt; $\\bad$ \\ 'i' \"j\""


class Seen(HTMLParser):
    """The elements of a text of HTML, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.text = set[str](), ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += data


def test_nothing_is_markup_in_html_and_markdown() -> None:
    markdown_it = pytest.importorskip("markdown_it")
    read = markdown_it.MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
    for page, tags in (
        (to_html(EVIL), set()),
        (f'<b title="{to_html(EVIL)}"></b>{to_html(EVIL)}', {"b"}),
        (read.render(to_markdown(EVIL)), {"p"}),
        (read.render(markdown([{"task": EVIL}])), {"table", "thead", "tbody", "tr", "th", "td"}),
    ):
        seen = Seen(page)
        assert seen.tags == tags and EVIL in seen.text


def test_a_terminal_gets_one_printable_line() -> None:
    said = one_line(InputError("runs/\x1b]0;title\x07\n\u202egnp.\udcff: damaged"))
    assert said == "runs/\\x1b]0;title\\x07 \\u202egnp.\\udcff: damaged"
