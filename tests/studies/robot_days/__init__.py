"""Robot-days of a fulfilment centre: site, situations with their rates, drives with the real estimators, rates with intervals."""
