//! What stands for the viewers where the program is built without them.

use std::net::SocketAddr;

use foxglove::Encode;

use super::LiveError;
use crate::recording::At;

/// There is none.
pub(in crate::recording) enum Live {}

impl Live {
    pub(in crate::recording) fn start(_: SocketAddr, _: &str) -> Result<Self, LiveError> {
        Err(LiveError::Absent)
    }

    pub(in crate::recording) fn addr(&self) -> SocketAddr {
        match *self {}
    }

    #[expect(clippy::extra_unused_type_parameters, reason = "as the other one's")]
    pub(in crate::recording) fn message<T: Encode>(&mut self, _: &'static str, _: At, _: &[u8]) {
        match *self {}
    }

    pub(in crate::recording) fn another(&mut self) {
        match *self {}
    }
}
