"""A scheduler and a worker of Dask, each the whole of a process."""

import os


def scheduler(port):
    """Run a scheduler on a port of this machine."""
    from distributed.cli.dask_scheduler import main

    _hush()
    main(["--port", port, "--host", "127.0.0.1", "--no-dashboard"])


def worker(address):
    """Run the worker of a scheduler, which nothing restarts."""
    from distributed.cli.dask_worker import main

    _hush()
    main([address, "--no-dashboard", "--no-nanny", "--nthreads", "1"])


def _hush():
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
