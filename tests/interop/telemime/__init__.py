"""The Telemime wire protocol, version 1, in Python.

Written from docs/protocol.md alone, with the standard library only, as a check of that document: whatever had to be looked
up elsewhere was a defect there. It is a reference for whoever writes another end, and made to be read, not to be fast.
"""
