# SPDX-License-Identifier: Apache-2.0
"""Takes an endpoint for a ZeroMQ socket, unless another program has it."""

import errno
import os
import socket

import zmq

from edge.errors import OutputError

_IPC = "ipc://"


def bind(zmq_socket: "zmq.Socket[bytes]", endpoint: str, key: str) -> str:
    """The endpoint as it was bound; OutputError names `key` of the settings where it cannot be."""
    try:
        if _is_served(endpoint):
            raise zmq.ZMQError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        zmq_socket.bind(endpoint)
    except (zmq.ZMQError, OSError) as error:
        zmq_socket.close()
        raise OutputError(
            f"{key} {endpoint}: {error.strerror}: end the other program there or name another "
            "endpoint"
        ) from error
    bound: str = zmq_socket.get_string(zmq.LAST_ENDPOINT)
    return bound


def _is_served(endpoint: str) -> bool:
    """Whether a program listens at a path, which ZeroMQ would take from it without a word.

    What a killed one has left there does not count.
    """
    path = endpoint.removeprefix(_IPC)
    if not endpoint.startswith(_IPC) or path.startswith(("@", "*")):
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(path)
        except BlockingIOError:
            return True  # it has more to accept than it can hold
        except OSError:
            return False
    return True
