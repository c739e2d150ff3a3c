"""Runs ``forewarp-train`` in forked processes, so that a killed run costs its run and not its imports.

``python zygote.py`` reads a job a line (JSON) and answers with two lines: the process's number at once, its
wait status at its end. A job has ``arguments``, ``log`` (where its output goes), and may have ``memory`` (a
limit on address space, bytes), ``file`` (a limit on a file's size, bytes) and ``die`` ([n, moment, end]:
SIGKILL at the n-th file that takes its place, ``before``, ``after`` or with ``half`` of it written; with an
``end`` only files count whose path ends so).
"""

import gc
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path


class Zygote:
    """The server's other end; a context."""

    def __enter__(self):
        # One thread: what was forked from several may wait for the others for ever.
        alone = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "COLUMNS": "200"}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": alone}
        self.server = subprocess.Popen([sys.executable, __file__], **pipes)
        return self

    def __exit__(self, *_):
        self.server.stdin.close()
        self.server.wait(30)
        self.server.stdout.close()

    def start(self, arguments, log, **limits):
        """Begin a run; returns its process's number."""
        job = {"arguments": list(map(str, arguments)), "log": str(log), **limits}
        self.server.stdin.write(json.dumps(job) + "\n")
        self.server.stdin.flush()
        return int(self.server.stdout.readline())

    def status(self):
        """Wait for the run's end; its exit status, or minus the signal that ended it."""
        return os.waitstatus_to_exitcode(int(self.server.stdout.readline()))

    def call(self, arguments, log, **limits):
        """Both."""
        self.start(arguments, log, **limits)
        return self.status()


def kill_at(number, moment, end=""):
    """Let the process die at the ``number``-th replacement of a file whose path ends so."""
    replace, seen = os.replace, [0]

    def deadly(source, target, **options):
        seen[0] += str(target).endswith(end)
        if seen[0] != number or not str(target).endswith(end):
            return replace(source, target, **options)
        if moment == "half":
            os.truncate(source, os.path.getsize(source) // 2)
        if moment == "after":
            replace(source, target, **options)
        return os.kill(os.getpid(), signal.SIGKILL)

    os.replace = deadly


def child(job):
    """Be ``forewarp-train``."""
    from forewarp.cli.train import main

    log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if "die" in job:
        kill_at(*job["die"])
    if "memory" in job:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + job["memory"], used + job["memory"]))
    if "file" in job:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (job["file"], job["file"]))
    sys.argv = ["forewarp-train", *job["arguments"]]
    try:
        main()
    except SystemExit as leaving:
        code = leaving.code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)


def serve():
    """Fork a child for every line."""
    from forewarp.cli.entry import quiet

    quiet()
    import lightning  # noqa: F401
    import matplotlib.backends.backend_agg  # noqa: F401
    import torch
    from PIL import Image

    import forewarp.cli.prepare
    import forewarp.evaluation.evaluate
    import forewarp.methods.particles.model
    import forewarp.methods.voxel.forward
    import forewarp.ops.kernels.voxels
    import forewarp.report.figures
    import forewarp.runs.build
    import forewarp.training.stages  # noqa: F401

    Image.init()
    torch.set_num_threads(1)
    gc.collect()
    gc.freeze()  # or every child would look through it all
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            try:
                child(json.loads(line))
            finally:
                os._exit(70)
        print(pid, flush=True)
        print(os.waitpid(pid, 0)[1], flush=True)


if __name__ == "__main__":
    serve()
