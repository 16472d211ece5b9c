//! The wire: one codec, versions, messages. `docs/protocol.md` is the normative text.

pub mod codec;
