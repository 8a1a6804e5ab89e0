"""The paired comparison of back ends: sequences, settings and seeds, statistics, tables, and one report in HTML.

`plan` says what is run, `trial` runs one piece of it, `sweep` spreads the pieces over cores and goes on where it was,
`statistics` says what follows, `tables` and `report` show it. May import `slam.run` and what
that may import.
"""
