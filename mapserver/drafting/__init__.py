"""From recordings to a draft in the store: admission, survey, merge, evidence, report, plots."""
