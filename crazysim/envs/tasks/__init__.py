"""Built-in tasks, a class each, and the parts that they share."""
