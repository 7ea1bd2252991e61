"""Localization part of VDA 5050 for a robot under a fleet manager. Its modules are imported once a broker is set."""

from fleetmap.errors import UsageError
from locclient.hooks import LinkedRobot, LinkHook, RobotLink
from locclient.identity import MapAddress
from locclient.plugins.vda5050.settings import Vda5050Section, check_section


def _check(section: Vda5050Section, address: MapAddress, insecure: bool) -> None:
    check_section(section, insecure=insecure)
    if address.store is not None:
        raise UsageError(
            "[vda5050] and store exclude each other: set server, whose signed lists define the admitted maps, or neither"
        )
    if address.server is None and section.versions == "map server":
        raise UsageError('[vda5050] versions = "map server" needs [run] server')


def _open(section: Vda5050Section, robot: LinkedRobot) -> RobotLink:
    from locclient.plugins.vda5050.mqtt_link import open_link

    return open_link(section, robot)


LINK = LinkHook(Vda5050Section, lambda section: section.broker is not None, _check, _open)
