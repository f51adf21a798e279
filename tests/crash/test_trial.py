import time
from typing import Any
def test_trial(prepared: Any, deploy: Any) -> None:
    d = deploy(0)
    w = d.start_solo_worker()
    time.sleep(40)
    print(w.said()); 
    import subprocess
    print(w.alive, w.pid); print(open(f"/proc/{w.pid}/wchan").read(), open(f"/proc/{w.pid}/status").read()[:300])
    print(d.client.health())
    assert 0
