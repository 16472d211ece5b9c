//! How a robot is reached, the first time and after every loss of the link.
//!
//! A link that has just come back carries a *fresh* attempt at once, while an older one waits for a retransmission
//! that QUIC has put off further and further. So attempts begin at a steady pace and overlap; the first of
//! them that the robot greets is the session, and the others are dropped. Once a robot has answered one of them at
//! all, no further ones begin for a while: on a thin link they would only stand in its way.

use std::net::SocketAddr;
use std::time::Duration;

use quinn::{ConnectError, Connecting, Connection, Endpoint};
use telemime_endpoint::control::{Control, ControlError, Writer};
use telemime_endpoint::quic::{self, Refusal};
use telemime_endpoint::reception::Received;
use telemime_protocol::wire::frame::{self, Frame};
use telemime_protocol::wire::hello::{Answer, RejectCode};
use telemime_protocol::wire::{Version, Versions};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

/// Attempts begin this far apart, so that with `HOLD` none is greeted later than two round trips and 250 ms after the link's
/// return …
pub const REDIAL: Duration = Duration::from_millis(230);

/// … and the first ones, of which nobody knows what the link carries, this.
const FIRST_REDIAL: Duration = Duration::from_millis(500);

/// Attempts begin this many times as far apart as the first packets' own length took on the last link, if that is
/// more; but no farther than [`SLOWEST_REDIAL`]. Each is two packets of 1.2 kB: on 64 kbit/s, four a second would fill a
/// queue for ever.
const LENGTHS: u32 = 3;
const SLOWEST_REDIAL: Duration = Duration::from_secs(2);

/// An attempt is given at least this long, and at least this many of the round trips last seen.
const LEAST_ATTEMPT: Duration = Duration::from_millis(500);
const ROUND_TRIPS: u32 = 4;

/// No further attempt begins for so long after a robot has answered one: the link is there, and the handshake has all of
/// it. Should it die again, the next attempt is no later than this.
const UNDISTURBED: Duration = Duration::from_secs(2);

/// The longest time-out of an attempt.
const LONGEST_ATTEMPT: Duration = Duration::from_secs(10);

/// A greeting that overtakes the handshake's last packet is thrown away, for the robot has no key to it yet. So it is held back:
/// for so long, or half the round trip if that is less …
const HOLD: Duration = Duration::from_millis(20);

/// … or so many times the jitter last seen (RFC 3550 §6.4.1), if that is more: packets whose delays spread evenly are never
/// farther apart than three times the mean that it estimates …
const JITTERS: u32 = 4;

/// … but no longer than a round trip, for a short one's jitter is the ends' own, and than this.
const LONGEST_HOLD: Duration = Duration::from_millis(100);

/// No answer for so long after the greeting, or after something else: it may have been thrown away all the same. QUIC
/// says it again after three round trips, or after one if packets that came later are acknowledged; a pair of them is at once.
const NUDGE: Duration = Duration::from_millis(30);
const NUDGES: u32 = 2;

/// Application close code of a robot that does not trust our key (docs/protocol.md §1).
const NOT_TRUSTED: u32 = 5;

/// A session's connection, greeted.
pub(crate) struct Link {
    pub(crate) connection: Connection,
    pub(crate) writer: Writer,
    pub(crate) frames: mpsc::Receiver<Result<Frame, ControlError>>,
    pub(crate) epoch: u32,
    pub(crate) version: Version,
    /// From the first packet to the answer; more than the round trip by what their lengths take.
    answered: Duration,
}

impl Link {
    /// What is to be known of the link, once it is lost.
    pub(crate) fn seen(&self, before: Option<Seen>) -> Seen {
        Seen::of(quic::least_rtt(&self.connection), self.answered, before)
    }
}

impl Seen {
    /// A link of which no jitter has been told yet has that of the one `before`.
    fn of(rtt: Duration, answered: Duration, before: Option<Self>) -> Self {
        let jitter = before.map_or(Duration::ZERO, |seen| seen.jitter);
        Self {
            rtt,
            answered,
            jitter,
        }
    }

    /// The least round trip counts: what a queue adds is no part of the path, and would have attempts wait for it.
    pub(crate) fn learn(&mut self, connection: &Connection) {
        self.shorten(quic::least_rtt(connection));
    }

    /// What has become of the datagrams each way, once the robot has said. A hand out of sight ages, and a clock that is set moves: only what both
    /// directions show is the link's.
    pub(crate) fn jittered(&mut self, up: Option<&Received>, down: &Received) {
        if let Some(up) = up {
            let least_s = up.jitter_s.min(down.jitter_s);
            self.jitter = Duration::try_from_secs_f64(least_s).unwrap_or_default();
        }
    }

    /// A path that has become shorter has no longer packets for it.
    fn shorten(&mut self, rtt: Duration) {
        self.answered = self.answered.saturating_sub(self.rtt.saturating_sub(rtt));
        self.rtt = self.rtt.min(rtt);
    }
}

/// What the last link was like.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    /// The least.
    rtt: Duration,
    answered: Duration,
    jitter: Duration,
}

/// Why an attempt did not become a session.
#[derive(Debug)]
pub(crate) enum DialError {
    /// The next one may.
    Again(String),
    /// None can any more: the endpoint has lost its socket.
    NoSocket,
    /// The robot declines.
    Rejected { code: RejectCode, text: String },
    /// The robot's key is not the one that is pinned.
    KeyChanged,
    /// The robot has revoked our key.
    Revoked,
}

/// How long attempts may take.
///
/// Most are given four round trips, no less than 0.5 s: time enough if the link is what it was. One at a time is
/// *patient*: its time-out doubles as such attempts fail, up to 10 s, for a link that has become slower. If all
/// were, forty of them would be retransmitting after a longer outage.
#[derive(Debug, Clone, Copy)]
struct Pace {
    apart: Duration,
    brisk: Duration,
    patient: Duration,
    jitter: Duration,
}

impl Pace {
    fn new(seen: Option<Seen>) -> Self {
        let (brisk, lengths) = seen.map_or((LEAST_ATTEMPT, Duration::ZERO), |seen| {
            let lengths = seen.answered.saturating_sub(seen.rtt);
            (seen.rtt * ROUND_TRIPS + lengths, lengths)
        });
        let least = seen.map_or(FIRST_REDIAL, |_| REDIAL);
        let brisk = brisk.clamp(LEAST_ATTEMPT, LONGEST_ATTEMPT);
        Self {
            apart: (lengths * LENGTHS).clamp(least, SLOWEST_REDIAL),
            brisk,
            patient: brisk,
            jitter: seen.map_or(Duration::ZERO, |seen| seen.jitter),
        }
    }

    /// How long a greeting waits for the handshake's last packet.
    fn hold(&self, rtt: Duration) -> Duration {
        let usual = HOLD.min(rtt / 2);
        let longest = rtt.min(LONGEST_HOLD);
        usual.max(self.jitter * JITTERS).min(longest)
    }

    fn next_patient(&mut self) -> Duration {
        self.patient = (self.patient * 2).min(LONGEST_ATTEMPT);
        self.patient
    }
}

/// Attempts under way.
pub(crate) struct Dialler {
    endpoint: Endpoint,
    robot: SocketAddr,
    offered: Versions,
    pace: Pace,
    attempts: JoinSet<(bool, Result<Link, DialError>)>,
    patient: bool,
    answered_tx: watch::Sender<Option<Instant>>,
    next: Instant,
}

impl Dialler {
    /// Begins with the first poll of [`Dialler::next`]; `seen` is what the last link was like.
    pub(crate) fn new(
        endpoint: &Endpoint,
        robot: SocketAddr,
        offered: Versions,
        seen: Option<Seen>,
    ) -> Self {
        Self {
            endpoint: endpoint.clone(),
            robot,
            offered,
            pace: Pace::new(seen),
            attempts: JoinSet::new(),
            patient: false,
            answered_tx: watch::Sender::new(None),
            next: Instant::now(),
        }
    }

    /// Attempts begin at `endpoint` from now on, at once; those under way go on where they began.
    pub(crate) fn move_to(&mut self, endpoint: &Endpoint) {
        self.endpoint = endpoint.clone();
        self.answered_tx.send_replace(None);
        self.next = Instant::now();
    }

    /// The outcome of an attempt; `None` when a new one has begun instead, so that the caller looks up from time
    /// to time. Loses nothing if it is dropped.
    pub(crate) async fn next(&mut self) -> Option<Result<Link, DialError>> {
        tokio::select! {
            biased;
            Some(done) = self.attempts.join_next(), if !self.attempts.is_empty() => {
                let (patient, outcome) = done.unwrap_or_else(|e| (false, Err(DialError::Again(e.to_string()))));
                if patient {
                    self.patient = false;
                }
                if outcome.is_err() {
                    // What was left undisturbed has failed: on with the others.
                    self.answered_tx.send_replace(None);
                }
                Some(outcome)
            }
            () = sleep_until(self.next) => {
                let now = Instant::now();
                self.next = now + self.pace.apart;
                let answered = *self.answered_tx.borrow();
                if !self.attempts.is_empty() && answered.is_some_and(|at| now < at + UNDISTURBED) {
                    return None;
                }
                let patient = !std::mem::replace(&mut self.patient, true);
                let within = if patient { self.pace.next_patient() } else { self.pace.brisk };
                let attempt = attempt(self.endpoint.clone(), self.robot, self.offered, (within, self.pace), self.answered_tx.clone());
                self.attempts.spawn(async move { (patient, attempt.await) });
                None
            }
        }
    }
}

/// An attempt is given `within` to be answered at all, and then as long as the longest.
async fn attempt(
    endpoint: Endpoint,
    robot: SocketAddr,
    offered: Versions,
    (within, pace): (Duration, Pace),
    answered: watch::Sender<Option<Instant>>,
) -> Result<Link, DialError> {
    let begun = Instant::now();
    let mut connecting = endpoint.connect(robot, "telemime").map_err(|e| match e {
        ConnectError::EndpointStopping => DialError::NoSocket,
        e => DialError::Again(e.to_string()),
    })?;
    let silent =
        |_| DialError::Again("no answer: is the robot running, and does UDP reach it?".to_owned());
    let answer = timeout(within, connecting.handshake_data()).await;
    answer.map_err(silent)?.map_err(|e| failed(&e))?;
    let now = Instant::now();
    answered.send_replace(Some(now));
    let rest = timeout(
        LONGEST_ATTEMPT,
        connect(connecting, offered, pace, now - begun),
    )
    .await;
    rest.map_err(silent)?
}

async fn connect(
    connecting: Connecting,
    offered: Versions,
    pace: Pace,
    answered: Duration,
) -> Result<Link, DialError> {
    let connection = connecting.await.map_err(|e| failed(&e))?;
    // With TLS 1.3 the handshake seems complete before the server has looked at our key.
    let again = |e: ControlError| match &e {
        ControlError::Connection(lost) => failed(lost),
        _ => connection
            .close_reason()
            .map_or_else(|| DialError::Again(e.to_string()), |lost| failed(&lost)),
    };
    sleep_until(Instant::now() + pace.hold(connection.rtt())).await;
    let mut control = Control::open(&connection).await.map_err(again)?;
    let hello = offered.hello().encode();
    control.write(&hello).await.map_err(again)?;
    let mut answer = timeout(NUDGE, control.answer()).await;
    for _ in 0..NUDGES {
        if answer.is_err() {
            let nothing = frame::encode(&[], true);
            control.write(&nothing).await.map_err(again)?;
            answer = timeout(NUDGE, control.answer()).await;
        }
    }
    let answer = match answer {
        Ok(answer) => answer,
        Err(_) => control.answer().await,
    };
    match answer.map_err(again)? {
        Answer::Ack { version, epoch, .. } => {
            let Some(version) = offered.known(version) else {
                return Err(DialError::Rejected {
                    code: RejectCode::Version,
                    text: format!("it answers with version {version}, which we did not offer"),
                });
            };
            let (writer, frames) = control.into_frames();
            Ok(Link {
                connection,
                writer,
                frames,
                epoch,
                version,
                answered,
            })
        }
        Answer::Reject { code, text } => Err(DialError::Rejected { code, text }),
    }
}

fn failed(error: &quinn::ConnectionError) -> DialError {
    if let quinn::ConnectionError::ApplicationClosed(close) = error
        && close.error_code == NOT_TRUSTED.into()
    {
        return DialError::Again(quic::explain(error));
    }
    match quic::refusal(error) {
        Some(Refusal::KeyUnknown | Refusal::KeyRevoked) => DialError::KeyChanged,
        Some(Refusal::OurKeyRevoked) => DialError::Revoked,
        Some(Refusal::OurKeyUnknown | Refusal::Version) | None => {
            DialError::Again(quic::explain(error))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_take_four_round_trips_and_one_of_them_is_ever_more_patient() {
        let ms = Duration::from_millis;
        for (rtt, brisk) in [
            (None, 500),
            (Some(20), 500),
            (Some(125), 520),
            (Some(600), 2420),
            (Some(60_000), 10_000),
        ] {
            let seen = |rtt| Seen {
                rtt: ms(rtt),
                answered: ms(rtt + 20),
                jitter: Duration::ZERO,
            };
            let mut pace = Pace::new(rtt.map(seen));
            let apart = rtt.map_or(FIRST_REDIAL, |_| REDIAL);
            assert_eq!(pace.apart, apart, "{rtt:?}");
            assert_eq!(pace.brisk, ms(brisk), "{rtt:?}");
            let mut due = brisk;
            for _ in 0..8 {
                due = (2 * due).min(10_000);
                assert_eq!(pace.next_patient(), ms(due));
            }
            assert_eq!(due, 10_000);
        }
    }

    #[test]
    fn a_greeting_waits_for_as_long_as_packets_are_apart() {
        let ms = Duration::from_millis;
        for (jitter, rtt, hold) in [
            (0, 100, 20),
            (0, 2, 1),
            (3, 8, 8),
            (3, 100, 20),
            (10, 100, 40),
            (90, 100, 100),
        ] {
            let seen = Seen {
                rtt: ms(rtt),
                answered: ms(rtt),
                jitter: ms(jitter),
            };
            assert_eq!(
                Pace::new(Some(seen)).hold(ms(rtt)),
                ms(hold),
                "{jitter}, {rtt}"
            );
        }
        assert_eq!(Pace::new(None).hold(ms(100)), HOLD);
    }

    #[test]
    fn a_link_that_is_lost_before_it_told_its_jitter_has_the_one_befores() {
        let ms = Duration::from_millis;
        let jittering = |jitter_s| Received {
            jitter_s,
            ..Received::default()
        };
        let mut first = Seen::of(ms(100), ms(100), None);
        first.jittered(Some(&jittering(0.02)), &jittering(0.01));
        let mut second = Seen::of(ms(90), ms(95), Some(first));
        assert_eq!(Pace::new(Some(second)).hold(ms(100)), ms(40));
        second.jittered(None, &jittering(0.5));
        assert_eq!(second.jitter, ms(10), "the robot has yet to say");
    }

    #[test]
    fn on_a_thin_link_attempts_are_farther_apart() {
        let ms = Duration::from_millis;
        for (answered, apart) in [(170, 230), (300, 600), (3_000, 2_000)] {
            let seen = Seen {
                rtt: ms(100),
                answered: ms(answered),
                jitter: Duration::ZERO,
            };
            assert_eq!(Pace::new(Some(seen)).apart, ms(apart));
            let mut shorter = seen;
            shorter.shorten(ms(20));
            assert_eq!(Pace::new(Some(shorter)).apart, ms(apart));
        }
    }
}
