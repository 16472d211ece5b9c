"""An operator in Python: QUIC by aioquic, everything above it by this folder's reading of docs/protocol.md."""

import asyncio
import hashlib
import os
import time

from aioquic.asyncio import QuicConnectionProtocol, connect
from aioquic.quic import events
from aioquic.quic.configuration import QuicConfiguration
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519

import exporter
from telemime import codec, frames, greeting, messages, pairing


def fingerprint(certificate):
    """SHA-256 of the SubjectPublicKeyInfo (§1)."""
    spki = certificate.public_key().public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    return hashlib.sha256(spki).hexdigest()


class Operator(QuicConnectionProtocol):
    """A session's sans-network half: what arrives is decoded, kept, and where the protocol says so answered."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.stream, self.buffer, self.epoch = None, b"", None
        self.control, self.telemetry, self.pings, self.closed = asyncio.Queue(), [], 0, None
        self.reception = None
        self.servo = None
        self.fresh = asyncio.Event()

    @staticmethod
    def clock_us():
        """The session clock: ours, monotonic, with a zero of its own."""
        return time.monotonic_ns() // 1000

    def quic_event_received(self, event):
        if isinstance(event, events.StreamDataReceived):
            self.buffer += event.data
            self.read_stream()
        elif isinstance(event, events.DatagramFrameReceived):
            self.read_datagram(event.data)
        elif isinstance(event, events.ConnectionTerminated):
            self.closed = event
            self.control.put_nowait({"Closed": {"code": event.error_code, "reason": event.reason_phrase}})
            self.fresh.set()

    def read_stream(self):
        if self.epoch is None:
            found = greeting.parse(self.buffer)
            if found is None:
                return
            answer, used = found
            self.buffer = self.buffer[used:]
            self.control.put_nowait(answer)
            if "HelloAck" not in answer:
                return
            self.epoch = answer["HelloAck"]["epoch"]
        while (found := frames.parse(self.buffer)) is not None:
            payload, ignorable, used = found
            self.buffer = self.buffer[used:]
            try:
                self.control.put_nowait(messages.read("robot control", payload))
            except codec.WireError:
                if not ignorable:
                    raise

    def read_datagram(self, data):
        ((name, fields),) = messages.read("robot datagram", data).items()
        if fields["epoch"] != self.epoch:
            return
        if name == "Ping":
            now = self.clock_us()
            self.pings += 1
            self.datagram({"Pong": {"epoch": self.epoch, "t1_us": fields["t1_us"], "t2_us": now, "t3_us": now}})
        elif name == "Reception":
            self.reception = fields
        elif name == "Servo":
            self.servo = fields
        else:
            self.telemetry.append(fields)
            self.fresh.set()

    def greet(self, lowest=1, highest=1):
        """Opens the control stream."""
        self.stream = self._quic.get_next_available_stream_id()
        self._quic.send_stream_data(self.stream, greeting.hello(lowest, highest))
        self.transmit()

    def say(self, message, end=False):
        """A control message."""
        self._quic.send_stream_data(self.stream, frames.frame(messages.write("operator control", message)), end)
        self.transmit()

    def datagram(self, message):
        self._quic.send_datagram_frame(messages.write("operator datagram", message))
        self.transmit()

    async def hear(self, name, within=10.0):
        """The next control message of this name; others before it are kept in `heard`."""
        async with asyncio.timeout(within):
            while True:
                message = await self.control.get()
                if isinstance(message, str):
                    message = {message: {}}
                if name in message:
                    return message[name]
                if "Closed" in message or "Refused" in message or "Reject" in message:
                    raise AssertionError(f"{message} instead of {name}")


class Pairing(QuicConnectionProtocol):
    """An end of a pairing (§14): its messages, and an operator's half of what is to be done with them."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.stream, self.buffer, self.heard = None, b"", asyncio.Queue()

    def quic_event_received(self, event):
        if isinstance(event, events.StreamDataReceived):
            self.stream = event.stream_id
            self.buffer += event.data
            while (found := pairing.parse(self.buffer)) is not None:
                message, used = found
                self.buffer = self.buffer[used:]
                self.heard.put_nowait(message)
        elif isinstance(event, events.ConnectionTerminated):
            self.heard.put_nowait({"Closed": {"code": event.error_code, "reason": event.reason_phrase}})

    def say(self, message, end=False):
        if self.stream is None:
            self.stream = self._quic.get_next_available_stream_id()
        self._quic.send_stream_data(self.stream, pairing.encode(message), end)
        self.transmit()

    async def hear(self, name, within=10.0):
        """The fields of the next message, which must be this one."""
        async with asyncio.timeout(within):
            message = await self.heard.get()
        fields = {} if message == name else message.get(name) if isinstance(message, dict) else None
        if fields is None:
            raise AssertionError(f"{message} instead of {name}")
        return fields

    def peer(self):
        """The fingerprint of the robot's key, as its handshake showed it."""
        return fingerprint(self._quic.tls._peer_certificate)

    def exported(self):
        return exporter.export(self._quic.tls.key_schedule, b"EXPORTER-telemime-pair-1", b"", 32)

    async def agree(self, name, certificate):
        """The code for both users to compare."""
        self.say({"Offer": {"name": name}})
        committed, nonce = (await self.hear("Commit"))["commitment"], os.urandom(32)
        self.say({"Nonce": {"nonce": nonce}})
        revealed = (await self.hear("Reveal"))["nonce"]
        assert pairing.commitment(revealed) == committed, "the robot's nonce is not the one it committed to"
        keys = [bytes.fromhex(key) for key in (fingerprint(certificate), self.peer())]
        return pairing.code(self.exported(), *keys, nonce, revealed)


def configured(alpn, key, certificate, is_client=True):
    configuration = QuicConfiguration(
        is_client=is_client, alpn_protocols=[alpn], server_name="telemime", max_datagram_frame_size=65535, idle_timeout=5.0
    )
    configuration.certificate, configuration.private_key = certificate, key
    # Names, dates and issuers mean nothing: the pin, or the code that users compare, is what is checked.
    configuration.verify_mode = 0
    return configuration


def introduce(host, port, key, certificate):
    """An `async with` of a Pairing."""
    configuration = configured("telemime-pair/1", key, certificate)
    return connect(host, port, configuration=configuration, create_protocol=Pairing)


def dial(host, port, key, certificate, pin):
    """An `async with` of an Operator whose robot has the pinned key."""
    return _Pinned(host, port, configured("telemime/1", key, certificate), pin)


class _Pinned:
    def __init__(self, host, port, configuration, pin):
        self.inner = connect(host, port, configuration=configuration, create_protocol=Operator)
        self.pin = pin

    async def __aenter__(self):
        operator = await self.inner.__aenter__()
        # aioquic has no hook for a pin; nothing has been sent on the stream before this.
        certificate = operator._quic.tls._peer_certificate
        if not isinstance(certificate.public_key(), ed25519.Ed25519PublicKey) or fingerprint(certificate) != self.pin:
            operator.close(error_code=0, reason_phrase="not the pinned key")
            raise AssertionError("the robot has another key")
        return operator

    async def __aexit__(self, *error):
        return await self.inner.__aexit__(*error)
