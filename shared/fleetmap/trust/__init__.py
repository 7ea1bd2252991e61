"""Signed lists of the maps that robots may run (TUF), and the robot's side of them. Imports tuf only to fetch a list."""

from fleetmap.trust.site_list import AdmittedVersion, SiteList, manifest_target, read_site_list, site_role
from fleetmap.trust.trusted_map import Ask, TrustedMap, ask_over

__all__ = [
    "AdmittedVersion",
    "Ask",
    "SiteList",
    "TrustedMap",
    "ask_over",
    "manifest_target",
    "read_site_list",
    "site_role",
]
