"""A stand-in for a server of others, on this machine, in a thread."""

import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

PATIENCE = 5.0  # [s] for the thread to end


class QuietHandler(BaseHTTPRequestHandler):
    """A handler of requests that logs nothing."""

    def log_message(self, *_):
        pass


@contextmanager
def served(handler, server=ThreadingHTTPServer):
    """Serve requests by a class of handlers; yields the server."""
    serving = server(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=serving.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield serving
    finally:
        serving.shutdown()
        serving.server_close()
        thread.join(PATIENCE)
