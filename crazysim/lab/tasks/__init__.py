"""Tasks that show a feature: loads, cars, cameras that look for a target.

They are found as the tasks of a user are, by the module and name of their class.
"""
