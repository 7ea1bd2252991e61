"""The acceptance report of a site: from a version and drives through it, how well robots will be localised, and where not."""
