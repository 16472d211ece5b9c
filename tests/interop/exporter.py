"""The TLS exporter (RFC 8446 §7.5), of which pairing (§14) makes its code. aioquic has none: its key schedule is taught to keep
the exporter's master secret on the way.
"""

from aioquic import tls


class _Schedule(tls.KeySchedule):
    exporter_master = None

    def derive_secret(self, label):
        # This secret is of the transcript up to the server's Finished, and so is the exporter's (§7.1).
        if label == b"c ap traffic":
            self.exporter_master = super().derive_secret(b"exp master")
        return super().derive_secret(label)


tls.KeySchedule = _Schedule


def export(schedule, label, context, length):
    """So many bytes that both ends of a finished handshake know, and nobody else."""

    def expand(secret, label, data, length):
        return tls.hkdf_expand_label(
            algorithm=schedule.algorithm, secret=secret, label=label, hash_value=data, length=length
        )

    hashed = tls.hashes.Hash(schedule.algorithm)
    empty = hashed.copy().finalize()
    hashed.update(context)
    secret = expand(schedule.exporter_master, label, empty, schedule.algorithm.digest_size)
    return expand(secret, b"exporter", hashed.finalize(), length)
