"""Jets of rotors on the surfaces of loads, from tables or closed forms."""
