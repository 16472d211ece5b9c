//! Where operators are paired: a window that a user opens on purpose, for one attempt.

use std::path::PathBuf;
use std::time::Duration;

use quinn::Connection;
use telemime_endpoint::cli::LONGEST_WINDOW;
use telemime_endpoint::pairing::{self, Candidate, Own, PairError};
use telemime_endpoint::peers::{Peer, Peers, PeersError, Role};
use telemime_endpoint::{Fingerprint, Trust};
use telemime_protocol::wire::pair::AbortCode;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

/// Two windows begin at least this far apart: nobody gets to guess codes quickly, whoever opens them.
pub const MIN_GAP: Duration = Duration::from_secs(5);

/// What there is to tell of a pairing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Progress {
    /// A window is open for this long.
    Open(Duration),
    /// No window yet: the last one began so shortly ago that this long must pass first.
    TooSoon(Duration),
    /// An operator shows this code; its user must be asked.
    Code(Candidate),
    /// The operator is trusted from now on.
    Paired(Candidate),
    /// The window is over without a pairing.
    Ended(PairError),
    /// There is nothing to say yes or no to.
    Nothing,
}

#[derive(Debug)]
enum Window {
    Open(Instant),
    /// Its one attempt has begun; the user's word is still owed or not.
    Used(Option<oneshot::Sender<bool>>),
}

/// A robot's pairing.
#[derive(Debug)]
pub struct Desk {
    own: Own,
    trust: Trust,
    store: Option<PathBuf>,
    expected: Option<Fingerprint>,
    window: Option<Window>,
    opened: Option<Instant>,
    steps_tx: mpsc::UnboundedSender<Progress>,
    steps: mpsc::UnboundedReceiver<Progress>,
}

impl Desk {
    /// A closed desk of the robot `own`. Operators that are paired go to `trust`, and to the file `store` if there
    /// is one; otherwise they are forgotten when the daemon ends.
    pub fn new(own: Own, trust: Trust, store: Option<PathBuf>) -> Self {
        let (steps_tx, steps) = mpsc::unbounded_channel();
        Self {
            own,
            trust,
            store,
            expected: None,
            window: None,
            opened: None,
            steps_tx,
            steps,
        }
    }

    /// Pairs with this key alone, and without asking: its user has compared the fingerprint already.
    #[must_use]
    pub fn expecting(mut self, key: Option<Fingerprint>) -> Self {
        self.expected = key;
        self
    }

    /// Whom the robot trusts.
    pub fn trust(&self) -> &Trust {
        &self.trust
    }

    /// Opens a window for `span`, in place of one that is open. One that is being decided goes on.
    pub fn open(&mut self, span: Duration) -> Progress {
        let now = Instant::now();
        let next = self.opened.map(|opened| opened + MIN_GAP);
        if let Some(next) = next.filter(|next| *next > now) {
            return Progress::TooSoon(next - now);
        }
        if let Some(Window::Used(_)) = self.window {
            return Progress::TooSoon(MIN_GAP);
        }
        let span = span.min(LONGEST_WINDOW);
        self.opened = Some(now);
        self.window = Some(Window::Open(now + span));
        self.trust.set_open(true);
        Progress::Open(span)
    }

    /// The user's word on the code that was shown; what to tell if there was none.
    pub fn word(&mut self, yes: bool) -> Option<Progress> {
        match &mut self.window {
            Some(Window::Used(owed @ Some(_))) => {
                // The operator may have gone in the meantime, which is told.
                let _ = owed.take().map(|owed| owed.send(yes));
                None
            }
            _ => Some(Progress::Nothing),
        }
    }

    /// The next thing to tell.
    pub async fn next(&mut self) -> Progress {
        let until = match self.window {
            Some(Window::Open(until)) => Some(until),
            _ => None,
        };
        let over = async {
            match until {
                Some(until) => tokio::time::sleep_until(until).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            Some(step) = self.steps.recv() => {
                if let Progress::Paired(_) | Progress::Ended(_) = step {
                    self.window = None;
                }
                step
            }
            () = over => {
                self.window = None;
                self.trust.set_open(false);
                Progress::Ended(PairError::Ours {
                    code: AbortCode::Expired,
                    text: "the pairing window is over: nobody came".into(),
                })
            }
        }
    }

    /// An operator that wants to be paired; says whether there is a window for it. It is told in any case.
    pub fn receive(&mut self, connection: Connection) -> bool {
        let (code, text) = match self.window {
            Some(Window::Open(until)) => {
                // One attempt: from here on nobody else gets through TLS.
                self.trust.set_open(false);
                let (word_tx, word) = oneshot::channel();
                let asked = self.expected.is_none();
                self.window = Some(Window::Used(asked.then_some(word_tx)));
                tokio::spawn(attempt(Attempt {
                    connection,
                    own: self.own.clone(),
                    expected: self.expected,
                    until,
                    word,
                    trust: self.trust.clone(),
                    store: self.store.clone(),
                    steps: self.steps_tx.clone(),
                }));
                return true;
            }
            Some(Window::Used(_)) => (AbortCode::Used, "the window has had its one attempt"),
            None => (AbortCode::Closed, "no pairing window is open"),
        };
        tokio::spawn(async move { pairing::decline(&connection, code, text).await });
        false
    }
}

struct Attempt {
    connection: Connection,
    own: Own,
    expected: Option<Fingerprint>,
    until: Instant,
    word: oneshot::Receiver<bool>,
    trust: Trust,
    store: Option<PathBuf>,
    steps: mpsc::UnboundedSender<Progress>,
}

async fn attempt(attempt: Attempt) {
    let steps = attempt.steps.clone();
    let end = match tried(attempt).await {
        Ok(candidate) => Progress::Paired(candidate),
        Err(e) => Progress::Ended(e),
    };
    // The daemon has ended if nobody receives.
    let _ = steps.send(end);
}

async fn tried(attempt: Attempt) -> Result<Candidate, PairError> {
    let Attempt {
        connection,
        own,
        expected,
        until,
        word,
        trust,
        store,
        steps,
    } = attempt;
    let answered = pairing::answer(&connection, &own).await?;
    let candidate = answered.candidate.clone();
    let word = async {
        match expected {
            Some(key) if key == candidate.key => Ok(()),
            Some(key) => Err(PairError::Ours {
                code: AbortCode::Declined,
                text: format!(
                    "the operator's key is {}, not the one expected, {key}",
                    candidate.key
                ),
            }),
            None => {
                let _ = steps.send(Progress::Code(candidate.clone()));
                // A word that never comes is none: the daemon has ended.
                pairing::word(word.await.unwrap_or(false))
            }
        }
    };
    let keep = |candidate: &Candidate| {
        if let Some(path) = &store {
            let peer = Peer::new(candidate.name.clone(), Role::Operator, candidate.key, None);
            Peers::edit(path, |peers| peers.pin(peer)).map_err(|e| not_stored(&e))?;
        }
        trust.pin(candidate.key);
        Ok(())
    };
    answered.settle(word, until, keep).await
}

fn not_stored(error: &PeersError) -> PairError {
    let code = match error {
        PeersError::NameTaken { .. } | PeersError::AddressTaken { .. } => AbortCode::NameTaken,
        PeersError::Revoked { .. } => AbortCode::Revoked,
        _ => AbortCode::Storage,
    };
    PairError::Ours {
        code,
        text: error.to_string(),
    }
}
