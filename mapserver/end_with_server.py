"""The command `mapserver`, ended when the server that started it ends: it then reads the end of its input."""

import os
import signal
import sys
import threading

from mapserver.cli import main


def _end_with_server() -> None:
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background process would ignore SIGINT
    threading.Thread(target=_end_with_server, daemon=True).start()
    sys.argv[0] = "mapserver"
    main()
