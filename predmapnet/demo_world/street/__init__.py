"""From a vector map to a street: looks, furniture, traffic."""
