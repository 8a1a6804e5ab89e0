"""Hostile input for every part that reads any: ``python -m tests.fuzz --help``; the short form is `test_fuzz.py`.

A class of inputs is a generator of cases. A case is made of a seed and its number alone, so each can be had again. It
holds where what is promised is kept: a result, or a `SlamError` of one line, within `harness.SECONDS` of processor time
and a bounded memory, with nothing printed.
"""
