//! Both ends of a pairing, over a connection that any key may open (docs/protocol.md §14).
//!
//! Each end first agrees on a code with its peer ([`offer`], [`answer`]), shows it to its user, and then
//! settles by the user's word ([`Offered::settle`], [`Answered::settle`]). Nothing is stored before both users
//! have agreed.

use std::future::Future;
use std::pin::pin;
use std::time::Duration;

use quinn::{Connection, RecvStream, SendStream};
use ring::rand::{SecureRandom, SystemRandom};
use telemime_protocol::wire::pair::{
    AbortCode, Bytes32, Code, EXPORTER_LABEL, MAX_LEN, Name, PairDecodeError, PairMessage,
    Transcript, commitment,
};
use tokio::time::{Instant, sleep_until, timeout};

use crate::control::GREETING_TIMEOUT;
use crate::identity::Fingerprint;
use crate::quic::{self, Refusal};
use crate::trust::key_of;

/// Last words are given this long to arrive.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// Why there was no pairing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PairError {
    /// The robot completes no handshake with an unknown key.
    #[error(
        "no pairing window is open at the robot, or it is over or used up: open one (`pair` on its terminal, or --pair), and try again"
    )]
    NoWindow,
    /// Our key was revoked there.
    #[error(
        "the robot has revoked our key: remove it there (`telemime peers remove`) before it can be paired again"
    )]
    Revoked,
    /// The connection ended.
    #[error("{0}")]
    Connection(String),
    /// The peer ended it.
    #[error("the other end ended the pairing: {text}")]
    Peer {
        /// Why, for machines.
        code: AbortCode,
        /// Why, for people.
        text: String,
    },
    /// We ended it.
    #[error("{text}")]
    Ours {
        /// Why, for machines.
        code: AbortCode,
        /// Why, for people.
        text: String,
    },
    /// A message is none.
    #[error("pairing: {0}")]
    Decode(#[from] PairDecodeError),
    /// The system gives no randomness, or TLS exports nothing.
    #[error("no randomness to be had from the system")]
    NoRandomness,
}

impl From<quinn::ConnectionError> for PairError {
    fn from(error: quinn::ConnectionError) -> Self {
        match quic::refusal(&error) {
            Some(Refusal::OurKeyUnknown | Refusal::Version) => Self::NoWindow,
            Some(Refusal::OurKeyRevoked) => Self::Revoked,
            _ => Self::Connection(quic::explain(&error)),
        }
    }
}

/// Whom the users are asked about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Candidate {
    /// What the peer calls itself.
    pub name: Name,
    /// Its key.
    pub key: Fingerprint,
    /// What both users must see.
    pub code: Code,
}

/// What an end brings along.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Own {
    /// What it calls itself.
    pub name: Name,
    /// Its key.
    pub key: Fingerprint,
}

struct Stream {
    connection: Connection,
    send: SendStream,
    recv: RecvStream,
    read: Vec<u8>,
}

impl Stream {
    fn new(connection: &Connection, (send, recv): (SendStream, RecvStream)) -> Self {
        Self {
            connection: connection.clone(),
            send,
            recv,
            read: Vec::new(),
        }
    }

    async fn say(&mut self, message: &PairMessage) -> Result<(), PairError> {
        let written = self.send.write_all(&message.encode()).await;
        written.map_err(|e| match e {
            quinn::WriteError::ConnectionLost(e) => e.into(),
            e => PairError::Connection(e.to_string()),
        })
    }

    /// The next message; an abort is an error. Loses nothing if it is dropped while it waits.
    async fn next(&mut self) -> Result<PairMessage, PairError> {
        loop {
            if let Some((message, used)) = PairMessage::decode(&self.read)? {
                self.read.drain(..used);
                return match message {
                    PairMessage::Abort(code, text) => Err(PairError::Peer {
                        code,
                        text: text.replace(char::is_control, " "),
                    }),
                    message => Ok(message),
                };
            }
            let mut buffer = [0; MAX_LEN];
            match self.recv.read(&mut buffer).await {
                Ok(Some(n)) => self.read.extend_from_slice(&buffer[..n]),
                Ok(None) => {
                    return Err(PairError::Connection("ended by the other end".into()));
                }
                Err(quinn::ReadError::ConnectionLost(e)) => return Err(e.into()),
                Err(e) => return Err(PairError::Connection(e.to_string())),
            }
        }
    }

    /// The next message, which is to come soon and has to satisfy `pick`.
    async fn expect<T>(
        &mut self,
        pick: impl FnOnce(PairMessage) -> Option<T>,
    ) -> Result<T, PairError> {
        let next = timeout(GREETING_TIMEOUT, self.next()).await;
        let next = next.map_err(|_| {
            let waited = GREETING_TIMEOUT.as_secs();
            let text = format!("the other end said nothing for {waited} s");
            ours(AbortCode::Malformed, text)
        })?;
        pick(next?).ok_or_else(|| ours(AbortCode::Malformed, "a message out of turn"))
    }

    /// Tells the peer why, if it does not know yet, and ends the connection.
    async fn end(mut self, error: PairError) -> PairError {
        let said = match &error {
            PairError::Ours { code, text } => Some((*code, text.clone())),
            PairError::Decode(e) => Some((AbortCode::Malformed, e.to_string())),
            _ => None,
        };
        if let Some((code, text)) = said {
            // The peer may be gone already; there is nobody else to tell.
            let _ = self.say(&PairMessage::Abort(code, text)).await;
        }
        self.close().await;
        error
    }

    async fn close(mut self) {
        let _ = self.send.finish();
        let _ = timeout(LAST_WORDS, self.send.stopped()).await;
        self.connection.close(0u32.into(), b"paired or not");
    }

    fn exporter(&self) -> Result<Bytes32, PairError> {
        let mut exported = [0; 32];
        self.connection
            .export_keying_material(&mut exported, EXPORTER_LABEL, &[])
            .map_err(|_| PairError::NoRandomness)?;
        Ok(exported)
    }

    fn peer_key(&self) -> Result<Fingerprint, PairError> {
        key_of(&self.connection)
            .ok_or_else(|| PairError::Connection("it has no key we can read".into()))
    }
}

fn ours(code: AbortCode, text: impl Into<String>) -> PairError {
    PairError::Ours {
        code,
        text: text.into(),
    }
}

fn nonce() -> Result<Bytes32, PairError> {
    let mut nonce = [0; 32];
    SystemRandom::new()
        .fill(&mut nonce)
        .map_err(|_| PairError::NoRandomness)?;
    Ok(nonce)
}

/// The operator's end, once it has a code.
pub struct Offered {
    stream: Stream,
    /// The robot.
    pub candidate: Candidate,
}

/// Offers ourselves to a robot (operator).
///
/// # Errors
/// [`PairError`]; the robot has been told.
pub async fn offer(connection: &Connection, own: &Own) -> Result<Offered, PairError> {
    let mut stream = Stream::new(connection, connection.open_bi().await?);
    match offering(&mut stream, own).await {
        Ok(candidate) => Ok(Offered { stream, candidate }),
        Err(e) => Err(stream.end(e).await),
    }
}

async fn offering(stream: &mut Stream, own: &Own) -> Result<Candidate, PairError> {
    stream.say(&PairMessage::Offer(own.name.clone())).await?;
    let commit = |message| match message {
        PairMessage::Commit(committed, name) => Some((committed, name)),
        _ => None,
    };
    let (committed, name) = stream.expect(commit).await?;
    let operator_nonce = nonce()?;
    stream.say(&PairMessage::Nonce(operator_nonce)).await?;
    let reveal = |message| match message {
        PairMessage::Reveal(nonce) => Some(nonce),
        _ => None,
    };
    let robot_nonce = stream.expect(reveal).await?;
    if commitment(&robot_nonce) != committed {
        let text = "the robot's nonce is not the one it committed to: somebody stands in between";
        return Err(ours(AbortCode::Commitment, text));
    }
    let key = stream.peer_key()?;
    let transcript = Transcript {
        exporter: stream.exporter()?,
        operator: own.key.bytes(),
        robot: key.bytes(),
        operator_nonce,
        robot_nonce,
    };
    Ok(Candidate {
        name,
        key,
        code: transcript.code(),
    })
}

impl Offered {
    /// Waits for our user's word and the robot's; on both, returns the robot, which has stored our key.
    ///
    /// # Errors
    /// [`PairError`]; the robot has been told.
    pub async fn settle(
        mut self,
        word: impl Future<Output = Result<(), PairError>>,
    ) -> Result<Candidate, PairError> {
        let settling = async {
            let mut word = pin!(word);
            tokio::select! {
                biased;
                word = &mut word => word?,
                early = self.stream.next() => {
                    early?;
                    return Err(ours(AbortCode::Malformed, "a message out of turn"));
                }
            }
            self.stream.say(&PairMessage::Confirm).await?;
            match self.stream.next().await? {
                PairMessage::Stored => Ok(()),
                _ => Err(ours(AbortCode::Malformed, "a message out of turn")),
            }
        };
        match settling.await {
            Ok(()) => {
                self.stream.close().await;
                Ok(self.candidate)
            }
            Err(e) => Err(self.stream.end(e).await),
        }
    }
}

/// The robot's end, once it has a code.
pub struct Answered {
    stream: Stream,
    /// The operator.
    pub candidate: Candidate,
}

/// Answers an operator that wants to be paired (robot).
///
/// # Errors
/// [`PairError`]; the operator has been told.
pub async fn answer(connection: &Connection, own: &Own) -> Result<Answered, PairError> {
    let mut stream = accept(connection).await?;
    match answering(&mut stream, own).await {
        Ok(candidate) => Ok(Answered { stream, candidate }),
        Err(e) => Err(stream.end(e).await),
    }
}

async fn accept(connection: &Connection) -> Result<Stream, PairError> {
    let accepted = timeout(GREETING_TIMEOUT, connection.accept_bi()).await;
    let accepted = accepted.map_err(|_| PairError::Connection("it opened no stream".into()))?;
    Ok(Stream::new(connection, accepted?))
}

async fn answering(stream: &mut Stream, own: &Own) -> Result<Candidate, PairError> {
    let offer = |message| match message {
        PairMessage::Offer(name) => Some(name),
        _ => None,
    };
    let name = stream.expect(offer).await?;
    let robot_nonce = nonce()?;
    let commit = PairMessage::Commit(commitment(&robot_nonce), own.name.clone());
    stream.say(&commit).await?;
    let nonce = |message| match message {
        PairMessage::Nonce(nonce) => Some(nonce),
        _ => None,
    };
    let operator_nonce = stream.expect(nonce).await?;
    stream.say(&PairMessage::Reveal(robot_nonce)).await?;
    let key = stream.peer_key()?;
    let transcript = Transcript {
        exporter: stream.exporter()?,
        operator: key.bytes(),
        robot: own.key.bytes(),
        operator_nonce,
        robot_nonce,
    };
    Ok(Candidate {
        name,
        key,
        code: transcript.code(),
    })
}

impl Answered {
    /// Waits for our user's word and the operator's until `deadline`; on both, lets `keep` store the key and
    /// tells the operator.
    ///
    /// # Errors
    /// [`PairError`], `keep`'s too; the operator has been told.
    pub async fn settle(
        mut self,
        word: impl Future<Output = Result<(), PairError>>,
        deadline: Instant,
        keep: impl FnOnce(&Candidate) -> Result<(), PairError>,
    ) -> Result<Candidate, PairError> {
        let settling = async {
            let mut word = pin!(word);
            let (mut agreed, mut confirmed) = (false, false);
            while !(agreed && confirmed) {
                tokio::select! {
                    biased;
                    () = sleep_until(deadline) => {
                        let text = "the pairing window ended before both users had agreed";
                        return Err(ours(AbortCode::Expired, text));
                    }
                    said = &mut word, if !agreed => {
                        said?;
                        agreed = true;
                    }
                    next = self.stream.next() => match next? {
                        PairMessage::Confirm if !confirmed => confirmed = true,
                        _ => return Err(ours(AbortCode::Malformed, "a message out of turn")),
                    }
                }
            }
            keep(&self.candidate)?;
            self.stream.say(&PairMessage::Stored).await
        };
        match settling.await {
            Ok(()) => {
                self.stream.close().await;
                Ok(self.candidate)
            }
            Err(e) => Err(self.stream.end(e).await),
        }
    }
}

/// Tells an operator at once that there will be no pairing (robot).
pub async fn decline(connection: &Connection, code: AbortCode, text: &str) {
    match accept(connection).await {
        Ok(stream) => drop(stream.end(ours(code, text)).await),
        Err(_) => connection.close(0u32.into(), text.as_bytes()),
    }
}

/// What a user's yes or no is to [`Offered::settle`] and [`Answered::settle`].
///
/// # Errors
/// [`PairError::Ours`] for a no.
pub fn word(yes: bool) -> Result<(), PairError> {
    if yes {
        Ok(())
    } else {
        Err(ours(
            AbortCode::Declined,
            "the user says that the codes differ, or wants no pairing",
        ))
    }
}
