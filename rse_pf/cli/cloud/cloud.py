"""Run the platform on AWS: deploy it, park it, show its health and its cost, and destroy it.

examples:
  rse-pf cloud up
  rse-pf cloud park --deep
  rse-pf cloud down
  rse-pf cloud doctor
  rse-pf cloud status
  rse-pf cloud leftovers
"""

from __future__ import annotations

from rse_pf.cli.cloud import (
    canary,
    doctor,
    down,
    leftovers,
    logs,
    park,
    resume,
    status,
    up,
    upgrade,
)  # fmt: skip
from rse_pf.command_line.options import Action, extension_actions

__all__ = ["ACTION"]

ACTION = Action(
    actions={
        "up": up.ACTION,
        "upgrade": upgrade.ACTION,
        "park": park.ACTION,
        "resume": resume.ACTION,
        "down": down.ACTION,
        "doctor": doctor.ACTION,
        **extension_actions(cost="rse_pf.extensions.costs.command"),
        "status": status.ACTION,
        "logs": logs.ACTION,
        "canary": canary.ACTION,
        "leftovers": leftovers.ACTION,
    }
)
