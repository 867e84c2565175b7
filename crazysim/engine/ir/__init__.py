"""The intermediate representation: programs of scalar operations, the table of operations, and their listing."""
