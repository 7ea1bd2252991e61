"""A survey joined to an existing map: located in it, adjusted together with it; only new parts are added."""
