"""A page about many runs that needs no network: curves, tables, what evolution did.

`evolution` reads lineages; `distances` and `playing` (with `battles`) make something of
checkpoints, and `made` says of which runs; `content` gathers what the page shows, `page` puts it
into one file with ``page.html``, ``page.js``, ``page.battles.js`` and ``page.css``, `serving` shows
it while runs go on. Looks may be changed in these assets alone; numbers come from
`race.viewing.comparison` and `race.viewing.curves` as they are.
"""
