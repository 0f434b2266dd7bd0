"""What each command of `turbogs` takes, checks and calls. What it calls is imported when it is called."""

from turbogs_plugin.commands import machine, models, studies, training
from turbogs_plugin.commands.parsing import Command

COMMANDS: dict[str, Command] = {
    "train": training.train,
    "plan": training.plan,
    "eval": models.evaluate,
    "render": models.render,
    "export": models.export,
    "view": models.view,
    "reconstruct": training.reconstruct,
    "ablate": studies.ablate,
    "report": studies.report,
    "bench": machine.bench,
    "demo": training.demo,
    "doctor": machine.doctor,
}
