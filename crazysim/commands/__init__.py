"""Commands of the command line. Each module has ``add_parsers`` and the functions that its commands run.

Most modules import what a command needs when it runs, so that ``crazysim --help`` is quick.
"""
