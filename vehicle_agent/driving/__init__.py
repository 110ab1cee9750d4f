"""One vehicle: its route, its motion, what it makes of answers and silence."""
