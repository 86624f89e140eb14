import os
import subprocess
import sys

from nurbseg.common.computer import limit_blas_threads

_CHILD = """
import os, sys
from nurbseg.{module} import main
assert "numpy" not in sys.modules, "the number of threads must be set before numpy is imported"
try:
    main({words})
except SystemExit:
    pass
print(os.environ.get("OPENBLAS_NUM_THREADS"))
"""


def test_a_number_that_the_user_has_set_counts():
    environment = {"OMP_NUM_THREADS": "2"}
    limit_blas_threads(environment)
    assert environment == {"OMP_NUM_THREADS": "2"}


def test_the_commands_ask_for_one_thread_before_numpy_is_imported():
    environment = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    for module, words in (
        ("app.command.live_command", ["--print-config"]),
        ("evaluation.eval_command", ["--help"]),
    ):
        run = subprocess.run(
            [sys.executable, "-c", _CHILD.format(module=module, words=words)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        assert run.stdout.splitlines()[-1] == "1", module
