"""A version's map in three dimensions: its bytes for the browser, and the element that draws them."""
