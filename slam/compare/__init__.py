"""The paired comparison of back ends: sequences, settings and seeds, statistics, tables, and one report in HTML.

`plan` says what is run, `trial` runs one piece of it, `scheduler` spreads the pieces over cores or a cluster, `sweep`
keeps what is done and goes on where it was, `measure` and `collect` put a run in numbers, `statistics` and `wording`
say what follows, `tables` and `report` write it down. May import `slam.run` and what that may import.
"""
