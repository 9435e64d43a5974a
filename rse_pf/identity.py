"""The identity of a robot, which is its tenant, name and enrolment: the only key for data of a robot.

Two tenants may have robots of the same name, and a name that was removed and enrolled again belongs to
another robot.  A dictionary, lock, path or lease whose key is the name alone would mix them up.
"""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple

__all__ = [
    "DEFAULT_TENANT",
    "RobotId",
    "folders_of",
    "name_segment",
    "object_name",
    "shown_name",
    "state_name",
]

# The tenant of robots and tokens that name none.
DEFAULT_TENANT = "default"
# A text that `name_segment` uses as it is: at most 64 lower-case letters, digits and hyphens.
_PLAIN_SEGMENT = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")


def name_segment(text: str) -> str:
    """Return *text* as one segment of an object's name; different texts have different segments.

    A text that is not plain (a lower-case letter or digit, then at most 63 of these and hyphens) becomes
    ``x=`` and its sha256 in hex.
    """
    if _PLAIN_SEGMENT.fullmatch(text):
        return text
    return "x=" + hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


class RobotId(NamedTuple):
    """One robot; a hashable value that two processes may exchange as a list of three texts.

    Attributes:
        tenant: The robot's tenant, which its token or its entry in the roster states.
        name: The robot's name, which no other robot of the tenant has at the same time.
        enrolment: RFC 7638 thumbprint of the key that was enrolled; "" for a robot whose tokens the platform
            signs, and where no token is required.
    """

    tenant: str
    name: str
    enrolment: str = ""

    def __str__(self) -> str:
        """Return the name as an operator writes it: ``TENANT/ROBOT``, or ``ROBOT`` in the default tenant."""
        is_plain = self.tenant == DEFAULT_TENANT and "/" not in self.name
        return self.name if is_plain else f"{self.tenant}/{self.name}"

    @property
    def folder(self) -> str:
        """``TENANT/ROBOT`` or, with an enrolment, ``TENANT/ROBOT=THUMBPRINT``: part of names of objects.

        Tenant and robot are segments by `name_segment`; no two robots have the same folder.
        """
        name = name_segment(self.name)
        return f"{name_segment(self.tenant)}/{name}{'=' if self.enrolment else ''}{self.enrolment}"


def object_name(robot: RobotId, digest: str) -> str:
    """Return the name of the object *digest* of *robot*: ``objects/TENANT/ROBOT[=THUMBPRINT]/DIGEST``."""
    return f"objects/{robot.folder}/{digest}"


def state_name(robot: RobotId, service: str) -> str:
    """Return the name of the object that stores the state of *service* for *robot*.

    It is ``states/TENANT/ROBOT[=THUMBPRINT]/SERVICE``.
    """
    return f"states/{robot.folder}/{service}"


def shown_name(folder: str) -> str:
    """Return the name of the robot with this `RobotId.folder`, without its tenant and enrolment.

    Of a name that `name_segment` replaced by a digest, the result is this segment, ``x=DIGEST``.
    """
    robot = folder.rpartition("/")[2]
    if robot.startswith("x="):
        return "=".join(robot.split("=")[:2])
    return robot.partition("=")[0]


def folders_of(name: str, folders: list[str]) -> list[str]:
    """Return those of *folders* (each a `RobotId.folder`) that belong to a robot with this *name*.

    The robots may have different tenants and enrolments.
    """
    wanted = {name, name_segment(name)}
    return [folder for folder in folders if shown_name(folder) in wanted]
