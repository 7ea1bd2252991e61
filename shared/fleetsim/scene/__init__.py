"""The warehouse: hall, racks, stock, light, moving things."""
