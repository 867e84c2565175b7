"""Commands of the laboratory, in the form of ``crazysim.commands``."""
