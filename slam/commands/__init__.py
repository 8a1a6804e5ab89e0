"""The command ``slam``: `cli` reads the command line, the other modules are its larger commands and what they print.

May import everything; nothing imports it.
"""
