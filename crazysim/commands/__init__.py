"""Commands of the command line: each module has ``add``, which adds parsers, and the functions that these run.

What a command needs is imported when it runs, so that ``crazysim --help`` is quick.
"""
