"""The page as one file: style, script, data and the drawing library inside it."""

import base64
import gzip
import html
import importlib.resources
from functools import cache
from typing import Any

from race.errors import RaceError
from race.viewing.report.content import as_text

# Nothing is fetched from anywhere, whatever a script might try; a page that is served asks its
# own server whether there is something new.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; media-src blob:; connect-src {connect}"
)


def page_of(content: Any, *, title: str, watched: str = "") -> str:
    """The whole page.

    Args:
        content: see `race.viewing.report.content`.
        title: shown at the top.
        watched: a fingerprint of the runs: the page loads itself again when it changes.

    Raises:
        RaceError: if plotly is not installed.
    """
    policy = _POLICY.format(connect="'self'" if watched else "'none'")
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{html.escape(title)}</title>",
            f"<style>{_asset('page.css')}</style></head>",
            f'<body data-watched="{html.escape(watched)}">{_asset("page.html")}',
            f'<script type="application/json" id="content">{as_text(content)}</script>',
            f'<script type="text/plain" id="plotly">{_plotly()}</script>',
            f"<script>{_asset('page.battles.js')}</script>",
            f"<script>{_asset('page.js')}</script></body></html>\n",
        ]
    ).replace("TITLE_OF_THE_PAGE", html.escape(title))


def message_page(text: str, watched: str) -> str:
    """A page that says why there is nothing to show yet, and looks again."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>race</title>'
        f'<meta http-equiv="refresh" content="3"><style>{_asset("page.css")}</style></head>'
        f'<body data-watched="{html.escape(watched)}"><main><p>{html.escape(text)}</p></main>'
        "</body></html>\n"
    )


def _asset(name: str) -> str:
    return (importlib.resources.files("race.viewing.report") / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    """The library's script, compressed: three of its five megabytes are saved."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise RaceError(
            "A report needs plotly, which is not installed: pip install 'race-marl[report]'"
        ) from error
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 9, mtime=0)).decode()
