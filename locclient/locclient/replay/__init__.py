"""A recording played through the localization client."""
