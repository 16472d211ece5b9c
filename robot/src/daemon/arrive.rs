//! How an operator comes to have authority: handshake and greeting beside the running session, then a place or a reason.

use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, ConnectionError, Incoming, VarInt};
use telemime_endpoint::control::{Control, ControlError};
use telemime_endpoint::{Fingerprint, Standing, Trust, quic, trust};
use telemime_protocol::skill::Skill;
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::pair;
use tokio::sync::mpsc;

use super::{Active, CLOSED, Daemon, NOT_TRUSTED, Notice};
use crate::door::Place;
use crate::refused::Reason;
use crate::session::Session;

/// Close codes (docs/protocol.md §1).
const REJECTED: u32 = 2;
const BAD_GREETING: u32 = 3;

/// An operator that comes back takes its own old session's place once that has been silent for two keep-alives:
/// its connection is dead, and only its time-out does not know yet.
const HALF_OPEN_S: f64 = 2.0 * quic::KEEP_ALIVE.as_millis() as f64 * 1e-3;

/// An operator's longest attempt to connect.
const OVERLAP_S: f64 = 10.0;

pub(super) struct Greeted {
    connection: Connection,
    key: Fingerprint,
    control: Control,
    hello: Hello,
}

/// What became of a connection that somebody opened.
pub(super) enum Arrival {
    Greeted(Box<Greeted>),
    /// It wants to be paired.
    Pairing(Connection),
    /// Turned away already.
    Refused(std::net::SocketAddr, Reason, String),
    /// It went by itself before it had said anything: an attempt that overlapped with a better one, or a dead link.
    Gone,
}

impl Daemon {
    /// Gives authority, or says why not.
    pub(super) fn admit(
        &mut self,
        greeted: Greeted,
        active: &mut Option<Active>,
        skill: &mut Option<Arc<Skill>>,
        epoch: &mut u32,
        notices: &mpsc::UnboundedSender<Notice>,
    ) -> Option<(std::net::SocketAddr, Reason, String)> {
        let Greeted {
            connection,
            key,
            control,
            hello,
        } = greeted;
        let now = self.clock.now();
        let agreed = self.config.versions.choose(&hello);
        let half_open = agreed.is_some()
            && active.as_mut().is_some_and(|held| {
                held.listen(now);
                held.key == key && now.secs_since(held.heard.1) >= HALF_OPEN_S
            });
        if half_open {
            let why = (CLOSED, "its operator has come back");
            self.end(active, skill, why, notices);
        }
        let versions = self.config.versions;
        let agreed = match agreed {
            None => Err((
                RejectCode::Version,
                Reason::Version,
                format!(
                    "this robot speaks {versions}, you offer {} to {}",
                    hello.min, hello.max
                ),
            )),
            Some(_) if active.is_some() => Err((
                RejectCode::Busy,
                Reason::Busy,
                "another operator has authority".to_owned(),
            )),
            Some(version) => Ok(version),
        };
        let peer = connection.remote_address();
        let version = match agreed {
            Ok(version) => version,
            Err((code, reason, text)) => {
                // Attempts of one operator overlap: those that were under way when it was let in are no news.
                let own = active.as_ref().is_some_and(|held| {
                    let overlaps = now.secs_since(held.began) < OVERLAP_S;
                    overlaps && held.key == key && held.connection.remote_address() == peer
                });
                let refused = (!own).then(|| (peer, reason, text.clone()));
                tokio::spawn(turn_away(connection, control, code, text));
                return refused;
            }
        };
        *epoch += 1;
        let ack = Answer::Ack {
            version: version.number(),
            features: 0,
            epoch: *epoch,
        };
        let (writer, frames) = control.into_frames();
        // The first of an empty queue.
        let _ = writer.raw(ack.encode());
        let session = Session::new(self.config, self.info.clone(), *epoch, skill.clone(), now)
            .speaking(version)
            .showing(self.arm.clone());
        *active = Some(Active {
            session,
            connection,
            key,
            began: now,
            heard: (0, now),
            writer,
            frames,
        });
        let _ = notices.send(Notice::Connected {
            epoch: *epoch,
            version,
            peer,
        });
        None
    }
}

/// What a key that is not trusted is turned away with.
pub(super) fn distrust(standing: Standing) -> (Reason, &'static str) {
    match standing {
        Standing::Revoked => (Reason::RevokedKey, "the operator's key was revoked"),
        Standing::Trusted | Standing::Unknown => {
            (Reason::UnknownKey, "the operator's key is not pinned here")
        }
    }
}

/// Handshake and greeting, beside the running session.
pub(super) async fn arrive(
    incoming: Incoming,
    _place: Place,
    trust: Trust,
    arrivals: mpsc::Sender<Arrival>,
) {
    let peer = incoming.remote_address();
    let arrival = greet(incoming, &trust).await;
    let arrival = arrival.unwrap_or_else(|(reason, why)| Arrival::Refused(peer, reason, why));
    // The daemon has stopped if nobody receives.
    let _ = arrivals.send(arrival).await;
}

async fn greet(incoming: Incoming, trust: &Trust) -> Result<Arrival, (Reason, String)> {
    let connection = match incoming.await {
        Ok(connection) => connection,
        Err(e) => {
            let reason = match (quic::refusal(&e), &e) {
                (Some(quic::Refusal::KeyUnknown), _) => Reason::UnknownKey,
                (Some(quic::Refusal::KeyRevoked), _) => Reason::RevokedKey,
                (Some(quic::Refusal::Version), _) => Reason::Version,
                (Some(_), _) | (None, ConnectionError::TransportError(_)) => Reason::Handshake,
                (None, _) => return Ok(Arrival::Gone),
            };
            return Err((reason, quic::explain(&e)));
        }
    };
    if quic::alpn(&connection).as_deref() == Some(pair::ALPN) {
        return Ok(Arrival::Pairing(connection));
    }
    // While a pairing window is open TLS lets unknown keys pass.
    let key = trust::key_of(&connection);
    let standing = key.map_or(Standing::Unknown, |key| trust.standing(key));
    let Some(key) = key.filter(|_| standing == Standing::Trusted) else {
        let (reason, why) = distrust(standing);
        connection.close(VarInt::from_u32(NOT_TRUSTED), why.as_bytes());
        return Err((reason, why.to_owned()));
    };
    let mut control = match Control::accept(&connection).await {
        Ok(control) => control,
        Err(ControlError::Connection(_)) => return Ok(Arrival::Gone),
        Err(e) => return Err((Reason::Greeting, e.to_string())),
    };
    match control.hello().await {
        Ok(hello) => Ok(Arrival::Greeted(Box::new(Greeted {
            connection,
            key,
            control,
            hello,
        }))),
        Err(ControlError::Connection(_) | ControlError::Stream(_)) => Ok(Arrival::Gone),
        Err(e) => {
            let text = e.to_string();
            turn_away(connection, control, RejectCode::Malformed, text.clone()).await;
            Err((Reason::Greeting, text))
        }
    }
}

/// Says why there is no session, and closes once that has been read.
async fn turn_away(connection: Connection, mut control: Control, code: RejectCode, text: String) {
    let close = match code {
        RejectCode::Malformed => BAD_GREETING,
        _ => REJECTED,
    };
    let say = async {
        // The peer may be gone already; there is nobody else to tell.
        let _ = control.write(&Answer::Reject { code, text }.encode()).await;
        let _ = control.send.finish();
        let _ = control.send.stopped().await;
    };
    let _ = tokio::time::timeout(Duration::from_secs(2), say).await;
    connection.close(VarInt::from_u32(close), b"rejected");
}
