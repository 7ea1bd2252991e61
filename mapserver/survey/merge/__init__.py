"""A survey joined to a map that is there already: found in it, adjusted together with it, and only what is new is taken over."""
