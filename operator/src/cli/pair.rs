//! `telemime pair`: an operator and a robot come to trust each other's keys.

use std::future::Future;
use std::io::{BufRead, Write};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use serde::Serialize;
use telemime_endpoint::pairing::{self, Candidate, Own, PairError};
use telemime_endpoint::peers::{Name, Peer, Peers, PeersError, Role};
use telemime_endpoint::{Fingerprint, Identity, admin, cli, quic};
use telemime_protocol::wire::pair::AbortCode;
use tokio::sync::oneshot;
use tokio::time::timeout;

/// Pair with a robot that has a pairing window open.
///
/// Both ends show a code of eight digits, made of both keys and this very connection; somebody in between would
/// make them differ. Compare them, and say yes at both ends, or type here the code that the robot shows, as a script
/// would that reads both ends' --json; only then is anything stored. The window is opened at
/// the robot, by `pair` on its terminal or --pair at its start, and is for one attempt.
#[derive(clap::Args, Debug, Clone)]
pub struct PairArgs {
    /// The robot.
    #[arg(value_name = "HOST:PORT")]
    pub robot: String,
    /// This operator's private key, made if missing [default: ~/.config/telemime/operator.key].
    #[arg(long, value_name = "FILE")]
    pub identity: Option<PathBuf>,
    /// Where the robot is remembered [default: ~/.config/telemime/peers].
    #[arg(long, value_name = "FILE")]
    pub peer_file: Option<PathBuf>,
    /// What this operator calls itself [default: the host's name].
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// What to call the robot here [default: what it calls itself].
    #[arg(long = "as", value_name = "NAME")]
    pub alias: Option<String>,
    /// Pair only with the key of this fingerprint, and without asking here; the robot's user still is asked.
    #[arg(long, value_name = "FINGERPRINT")]
    pub expect: Option<String>,
    /// Give up if the robot does not answer within this time, s.
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    pub patience: f64,
    /// Print events as JSON lines on stdout; yes, no or the robot's code is read from stdin all the same.
    #[arg(long)]
    pub json: bool,
}

#[derive(Serialize)]
struct Event<'a> {
    event: &'a str,
    name: &'a str,
    fingerprint: String,
    short: String,
    code: String,
}

/// Runs `pair`.
///
/// # Errors
/// One line that says what to do.
pub fn pair(args: &PairArgs) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    runtime.block_on(paired(args))
}

async fn paired(args: &PairArgs) -> anyhow::Result<()> {
    let own_name = admin::own_name(args.name.as_deref())?;
    let alias = args
        .alias
        .as_deref()
        .map(|text| admin::own_name(Some(text)));
    let alias = alias.transpose()?;
    let expected: Option<Fingerprint> = args.expect.as_deref().map(str::parse).transpose()?;
    if !(args.patience > 0.0 && args.patience <= 3600.0) {
        bail!(
            "--patience is {}: it must be above 0 and at most 3600",
            args.patience
        );
    }
    let robot = cli::resolve(&args.robot).map_err(anyhow::Error::msg)?;
    let file = args.peer_file.clone().unwrap_or_else(admin::peer_file);
    let known = Peers::load(&file)?;
    let key = args.identity.clone();
    let identity =
        Identity::load_or_create(&key.unwrap_or_else(|| admin::key_file(Role::Operator)))?;
    let own = Own {
        name: own_name,
        key: identity.fingerprint(),
    };
    let socket = quic::Socket::bind(super::any_port(robot))?;
    let endpoint = quic::pairing_client(&identity, socket)?;
    let connecting = endpoint.connect(robot, "telemime")?;
    let connecting = async {
        let connection = connecting.await?;
        pairing::offer(&connection, &own).await
    };
    let patience = Duration::from_secs_f64(args.patience);
    let offered = timeout(patience, connecting).await.map_err(|_| {
        anyhow::anyhow!("no answer from {robot}: is the robot running, and does UDP reach it?")
    })??;
    let shown = offered.candidate.clone();
    let name = alias.unwrap_or_else(|| shown.name.clone());
    let peer = Peer::new(name, Role::Robot, shown.key, Some(args.robot.clone()));
    let word = decide(args.json, &shown, &known, &peer, expected);
    let agreed = offered.settle(word).await;
    let agreed = agreed.with_context(|| format!("not paired with {}", args.robot))?;
    let stored = Peers::edit(&file, |peers| peers.pin(peer.clone()));
    stored
        .context("the robot trusts us now, but we cannot remember it; mend this and pair again")?;
    endpoint.wait_idle().await;
    show(args.json, "paired", &agreed, &peer.name, || {
        format!(
            "paired with {}, fingerprint {}\ndrive it with: telemime operator --connect {}",
            peer.name, peer.key, peer.name
        )
    })
}

/// Our word: a no if the robot is known by another key, yes if its key is the one expected, else the user's.
async fn decide(
    json: bool,
    shown: &Candidate,
    known: &Peers,
    peer: &Peer,
    expected: Option<Fingerprint>,
) -> Result<(), PairError> {
    let refused = |code, text| Err(PairError::Ours { code, text });
    if let Err(e) = known.clone().pin(peer.clone()) {
        let code = match e {
            PeersError::Revoked { .. } => AbortCode::Revoked,
            _ => AbortCode::NameTaken,
        };
        return refused(code, e.to_string());
    }
    if let Some(expected) = expected.filter(|key| *key != shown.key) {
        let text = format!(
            "the robot's key is {}, not the one expected, {expected}: somebody may be in between",
            shown.key
        );
        return refused(AbortCode::Declined, text);
    }
    let asked = expected.is_none();
    let text = || {
        let ask = if asked {
            "Does the robot show the same? Type yes or no here and there."
        } else {
            "Its key is the one expected. Now the robot's user is asked."
        };
        format!(
            "robot {}, key {}\n\n    {}\n\n{ask}",
            shown.name,
            shown.key.short(),
            shown.code
        )
    };
    // Whom we cannot show the code we cannot ask.
    let seen = show(json, "code", shown, &peer.name, text).is_ok();
    if !asked {
        return Ok(());
    }
    pairing::word(seen && user_says_yes(shown.code.to_string()).await)
}

/// What a line of the user's says to `code`: yes, no, or nothing that is understood.
fn answer(line: &str, code: &str) -> Option<bool> {
    let digits = |text: &str| -> String { text.split_whitespace().collect() };
    match line.trim() {
        "yes" => Some(true),
        "no" => Some(false),
        other if !other.is_empty() && digits(other).bytes().all(|b| b.is_ascii_digit()) => {
            Some(digits(other) == digits(code))
        }
        _ => None,
    }
}

/// The next answer on stdin; its end is a no.
fn user_says_yes(code: String) -> impl Future<Output = bool> {
    let (word_tx, word) = oneshot::channel();
    // A thread of its own, never joined: a blocking read cannot be cancelled, and ends with the process.
    let asking = std::thread::Builder::new().spawn(move || {
        let words = std::io::stdin().lock().lines().map_while(Result::ok);
        for line in words {
            match answer(&line, &code) {
                Some(true) => {
                    let _ = word_tx.send(true);
                    return;
                }
                Some(false) => break,
                None => eprintln!("yes, no, or the code the robot shows?"),
            }
        }
        let _ = word_tx.send(false);
    });
    async move { asking.is_ok() && word.await.unwrap_or(false) }
}

fn show(
    json: bool,
    event: &str,
    robot: &Candidate,
    name: &Name,
    text: impl FnOnce() -> String,
) -> anyhow::Result<()> {
    let line = if json {
        serde_json::to_string(&Event {
            event,
            name: name.as_ref(),
            fingerprint: robot.key.to_string(),
            short: robot.key.short(),
            code: robot.code.to_string(),
        })?
    } else {
        text()
    };
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}").and_then(|()| out.flush())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_robots_code_is_a_yes_and_any_other_a_no() {
        let says = |line| answer(line, "0204 2024");
        for yes in [" yes ", "0204 2024", "02042024"] {
            assert_eq!(says(yes), Some(true), "{yes}");
        }
        for no in ["no", "0204 2025", "2042024", "0"] {
            assert_eq!(says(no), Some(false), "{no}");
        }
        for neither in ["", "  ", "y", "0204-2024", "yes 0204 2024"] {
            assert_eq!(says(neither), None, "{neither}");
        }
    }
}
