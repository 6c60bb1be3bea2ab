"""Garbage collection of a daemon."""

import subprocess
import sys

STORY = """
import gc
from common.runtime.daemon import leave, run_daemon, set_up_logging
from common.runtime.garbage import collect_later

collect_later()
set_up_logging()

async def main(daemon):
    print("while it starts:", gc.isenabled(), gc.get_freeze_count())
    daemon.announce_ready()
    print("afterwards:", gc.isenabled(), gc.get_freeze_count() > 10_000, len(gc.get_objects()) < 1_000)

code = run_daemon("story", main)
print(flush=True)
leave(code)
"""


def test_nothing_is_collected_while_a_daemon_starts_and_what_the_start_made_is_looked_through_no_more() -> None:
    ran = subprocess.run([sys.executable, "-c", STORY], capture_output=True, text=True, timeout=30, check=True)
    assert ran.stdout.split("\n")[:2] == ["while it starts: False 0", "afterwards: True True True"]
