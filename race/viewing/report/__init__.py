"""A page about many runs that needs no network: curves, tables, what evolution did.

`evolution` reads lineages, `content` gathers what the page shows, `page` puts it into one file with
`page.js` and `page.css`, `serving` shows it while runs go on. Looks may be changed in the two
assets alone; numbers come from `race.viewing.comparison` and `race.viewing.curves` as they are.
"""
