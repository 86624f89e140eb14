"""The entry point of nurbseg-eval, which imports everything else."""

from functools import partial

from nurbseg.app.commands import ENDS, run

evaluation = partial(run, "nurbseg.evaluation.eval_command", "command", also=ENDS)
