//! What both daemons' command lines share.

use std::io::{self, BufRead, IsTerminal, Read, Write};
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::Duration;

use ring::rand::{SecureRandom, SystemRandom};
use serde::Serialize;
use telemime_protocol::wire::{Version, Versions};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, watch};

use crate::config::Unusable;

/// The daemons' own folder: `$XDG_CONFIG_HOME/telemime`, else `$HOME/.config/telemime`, else here.
pub fn config_dir() -> PathBuf {
    let set = |name: &str| {
        std::env::var_os(name)
            .filter(|v| !v.is_empty())
            .map(PathBuf::from)
    };
    set("XDG_CONFIG_HOME")
        .or_else(|| set("HOME").map(|home| home.join(".config")))
        .unwrap_or_default()
        .join("telemime")
}

/// What a program ends with: 0, 1 (failed, with one line on stderr) or 2 (a configuration that cannot be; `Ok(false)` has said so).
pub fn exit_code(program: &str, done: &anyhow::Result<bool>) -> ExitCode {
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(2),
        Err(e) => {
            eprintln!("{program}: {}", one_line(e.chain()));
            failure(e)
        }
    }
}

/// 2 if what was set cannot be, and 1 else.
pub fn failure(error: &anyhow::Error) -> ExitCode {
    if error.is::<Unusable>() {
        ExitCode::from(2)
    } else {
        ExitCode::FAILURE
    }
}

/// The first address a `host:port` stands for.
///
/// # Errors
/// One line that says what to write instead.
pub fn resolve(text: &str) -> Result<SocketAddr, String> {
    let found = text
        .to_socket_addrs()
        .map_err(|e| format!("`{text}`: {e}; write host:port, for example 192.168.1.20:4433"))?;
    let found: Vec<_> = found.collect();
    // An IPv4 address first: that is what the endpoint's socket is bound for by default.
    let first = found.iter().find(|a| a.is_ipv4()).or(found.first());
    first
        .copied()
        .ok_or_else(|| format!("`{text}` has no address"))
}

/// `--protocol-max` names a version this build does not know.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("--protocol-max {number}: this build knows protocol version 1, and 2 as an experiment")]
pub struct UnknownVersion {
    /// The number given.
    pub number: u16,
}

/// The protocol versions of `--protocol-max`: from 1 to it, and 1 alone without it.
///
/// # Errors
/// [`UnknownVersion`].
pub fn versions(highest: Option<u16>) -> Result<Versions, UnknownVersion> {
    let Some(number) = highest else {
        return Ok(Versions::default());
    };
    Version::from_number(number)
        .and_then(|highest| Versions::new(Version::V1, highest))
        .ok_or(UnknownVersion { number })
}

/// Sixteen bytes that nobody can guess.
///
/// # Errors
/// The system's, if it has no randomness.
pub fn secret() -> io::Result<[u8; 16]> {
    let mut bytes = [0; 16];
    SystemRandom::new()
        .fill(&mut bytes)
        .map_err(|_| io::Error::other("the system has no randomness"))?;
    Ok(bytes)
}

/// An error and its causes in one line, each said once: a cause that the text before it quotes is left out.
pub fn one_line<'a>(
    chain: impl IntoIterator<Item = &'a (dyn std::error::Error + 'static)>,
) -> String {
    let mut line = String::new();
    for cause in chain {
        let text = cause.to_string();
        if !line.contains(&text) {
            if !line.is_empty() {
                line.push_str(": ");
            }
            line.push_str(&text);
        }
    }
    line.replace('\n', " ")
}

/// Prints lines on stdout; a reader that has read enough is no error.
///
/// # Errors
/// The system's.
pub fn say(text: &str) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        // Whoever reads has read enough.
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        done => Ok(done?),
    }
}

/// Lines a terminal or pipe may leave unread before more are dropped.
const MAX_UNREAD_LINES: usize = 4096;

/// Prints lines on stdout from a thread of its own, so that a terminal that is stopped, or a pipe that
/// nobody reads, holds up nothing but the printing.
#[derive(Debug, Clone)]
pub struct Printer(SyncSender<Job>);

#[derive(Debug)]
enum Job {
    Print(String),
    /// All before it is printed.
    Tell(SyncSender<()>),
}

/// The printing thread; to be waited for at the end.
#[derive(Debug)]
pub struct Printing(Receiver<()>);

impl Printer {
    /// Starts printing on stdout.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start() -> io::Result<(Self, Printing)> {
        Self::onto(|line| {
            let mut out = io::stdout().lock();
            writeln!(out, "{line}").and_then(|()| out.flush())
        })
    }

    /// The same on stderr.
    ///
    /// # Errors
    /// The system's, if it gives no thread.
    pub fn start_on_stderr() -> io::Result<(Self, Printing)> {
        Self::onto(|line| writeln!(io::stderr().lock(), "{line}"))
    }

    fn onto(
        print: impl Fn(&str) -> io::Result<()> + Send + 'static,
    ) -> io::Result<(Self, Printing)> {
        let (lines_tx, lines) = sync_channel(MAX_UNREAD_LINES);
        let (done, printing) = sync_channel(1);
        thread::Builder::new()
            .name("printer".into())
            .spawn(move || {
                for job in lines {
                    match job {
                        // A reader that has gone away is not our concern.
                        Job::Print(line) => drop(print(&line)),
                        Job::Tell(printed) => drop(printed.try_send(())),
                    }
                }
                let _ = done.send(());
            })?;
        Ok((Self(lines_tx), Printing(printing)))
    }

    /// Prints a line; drops it if too many are unread.
    pub fn say(&self, line: String) {
        // A full queue: whoever is to read has stopped reading.
        let _ = self.0.try_send(Job::Print(line));
    }

    /// Waits until what was said before is printed, but not for a reader that does not read.
    pub fn flush(&self) {
        let (printed, told) = sync_channel(1);
        if self.0.try_send(Job::Tell(printed)).is_ok() {
            let _ = told.recv_timeout(Duration::from_secs(1));
        }
    }

    /// Prints `event` as one line of JSON.
    pub fn emit(&self, event: &impl Serialize) {
        if let Ok(line) = serde_json::to_string(event) {
            self.say(line);
        }
    }
}

impl Printing {
    /// Waits until everything is printed, but not for a reader that does not read. All printers must be gone.
    pub fn finish(self) {
        let _ = self.0.recv_timeout(Duration::from_secs(1));
    }
}

/// A word typed at a daemon's terminal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Word {
    /// `stop`: emergency stop.
    Stop,
    /// `reset`: leave the latched stop.
    Reset,
    /// `blackbox`: write the record of the last minutes.
    BlackBox,
    /// `pair` or `pair 30s`: open a pairing window.
    Pair(Duration),
    /// `yes`: the codes are the same.
    Yes,
    /// `no`: they are not.
    No,
    /// `engage`: the tracked hand drives from here.
    Engage,
    /// `release`: it does not any more.
    Release,
    /// `keep`: the performance just driven is worth learning from.
    Keep,
    /// `refine`: learn from what was kept.
    Refine,
    /// `save FILE`: write the skill as it is now.
    Save(PathBuf),
}

/// How long a window is open that was asked for without saying how long.
pub const PAIRING_WINDOW: Duration = Duration::from_secs(60);

/// The longest pairing window.
pub const LONGEST_WINDOW: Duration = Duration::from_secs(600);

/// What a robot's terminal understands.
pub const ROBOT_WORDS: &str = "stop, reset, blackbox, pair, yes, no or quit";

/// What an operator's terminal understands.
pub const OPERATOR_WORDS: &str = "stop, reset, engage, release, keep, refine, save FILE or quit";

impl Word {
    /// The word of a line, if it is one of `known` ([`ROBOT_WORDS`], [`OPERATOR_WORDS`]).
    fn parse(line: &str, known: &str) -> Option<Self> {
        let (word, rest) = line.split_once(' ').unwrap_or((line, ""));
        let mut listed = known.split([' ', ',']);
        if !listed.any(|listed| listed == word) {
            return None;
        }
        match (word, rest.trim()) {
            ("stop", "") => Some(Self::Stop),
            ("reset", "") => Some(Self::Reset),
            ("blackbox", "") => Some(Self::BlackBox),
            ("pair", "") => Some(Self::Pair(PAIRING_WINDOW)),
            ("pair", span) => seconds(span).ok().map(Self::Pair),
            ("yes", "") => Some(Self::Yes),
            ("no", "") => Some(Self::No),
            ("engage", "") => Some(Self::Engage),
            ("release", "") => Some(Self::Release),
            ("keep", "") => Some(Self::Keep),
            ("refine", "") => Some(Self::Refine),
            ("save", file) if !file.is_empty() => Some(Self::Save(file.into())),
            _ => None,
        }
    }
}

/// A length of time of whole or broken seconds: `60s`, `60` or `0.5s`; at most ten minutes.
///
/// # Errors
/// One line that says what to write.
pub fn seconds(text: &str) -> Result<Duration, String> {
    let number = text.strip_suffix('s').unwrap_or(text).parse::<f64>();
    let number = number
        .ok()
        .filter(|s| *s > 0.0 && *s <= LONGEST_WINDOW.as_secs_f64());
    number
        .map(Duration::from_secs_f64)
        .ok_or_else(|| format!("`{text}`: write seconds, for example 60s, and at most 600s"))
}

/// How wrong a disciplined clock may be: `50us`, `0.2ms` or `0.001s`, at most a second.
///
/// # Errors
/// One line that says what to write.
pub fn dispersion(text: &str) -> Result<Duration, String> {
    let scaled = [("us", 1e-6), ("ms", 1e-3), ("s", 1.0)]
        .into_iter()
        .find_map(|(unit, s)| Some((text.strip_suffix(unit)?, s)));
    let seconds = scaled.and_then(|(number, s)| Some(number.trim().parse::<f64>().ok()? * s));
    seconds
        .filter(|s| *s > 0.0 && *s <= 1.0)
        .map(Duration::from_secs_f64)
        .ok_or_else(|| format!("`{text}`: write for example 50us or 2ms, at most 1s"))
}

/// Resolves once the watch is true, or its sender is gone.
pub async fn told(quit: &mut watch::Receiver<bool>) {
    let _ = quit.wait_for(|quit| *quit).await;
}

/// No word is longer than this with what is said of it, B.
const LONGEST_LINE: u64 = 4096;

/// Lines, of which what is no UTF-8 is replaced and what is too long comes in pieces: only the end or an error of the source
/// ends them.
fn lines(mut from: impl BufRead) -> impl Iterator<Item = String> {
    let mut bytes = Vec::new();
    std::iter::from_fn(move || {
        bytes.clear();
        let read = from
            .by_ref()
            .take(LONGEST_LINE)
            .read_until(b'\n', &mut bytes);
        let some = read.is_ok_and(|n| n > 0);
        some.then(|| String::from_utf8_lossy(&bytes).into_owned())
    })
}

/// Ctrl-C, SIGTERM, `quit`, or (if asked for) the end of stdin turn the watch true, each of them anew; the other words of `known`
/// arrive as such (`stop` is also called at once, on the reading thread). stdin is read only when it is a terminal or `follow_stdin` is set.
///
/// # Errors
/// The system's, if signals cannot be caught.
pub fn listen(
    follow_stdin: bool,
    known: &'static str,
    stop: impl Fn() + Send + 'static,
) -> io::Result<(watch::Receiver<bool>, mpsc::UnboundedReceiver<Word>)> {
    let (quit_tx, quit) = watch::channel(false);
    let (word_tx, words) = mpsc::unbounded_channel();
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    let by_signal = quit_tx.clone();
    tokio::spawn(async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            by_signal.send_replace(true);
        }
    });
    if follow_stdin || io::stdin().is_terminal() {
        // A thread of its own, never joined: a blocking read cannot be cancelled, and ends with the process.
        thread::Builder::new().name("stdin".into()).spawn(move || {
            for line in lines(io::stdin().lock()) {
                let line = line.trim();
                if line == "quit" {
                    break;
                }
                let Some(word) = Word::parse(line, known) else {
                    eprintln!("{known}?");
                    continue;
                };
                if word == Word::Stop {
                    stop();
                }
                let _ = word_tx.send(word);
            }
            quit_tx.send_replace(true);
        })?;
    } else {
        // Keeps the channel open: no words will come, and that is not the end.
        std::mem::forget(word_tx);
    }
    Ok((quit, words))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("key.pem: {source}")]
    struct Quoting {
        source: std::io::Error,
    }

    #[test]
    fn words_are_those_the_terminal_knows() {
        let said = |line| Word::parse(line, OPERATOR_WORDS);
        assert_eq!(said("stop"), Some(Word::Stop));
        assert_eq!(
            said("save  my swing.skill"),
            Some(Word::Save("my swing.skill".into()))
        );
        for line in ["", "save", "stop it", "FILE", "or", "stopp"] {
            assert_eq!(said(line), None, "{line}");
        }
        assert_eq!(Word::parse("keep", ROBOT_WORDS), None);
        assert_eq!(Word::parse("reset", ROBOT_WORDS), Some(Word::Reset));
    }

    #[test]
    fn what_is_no_text_ends_nothing() {
        let said: Vec<_> = lines(&b"x\xff\nstop\nend"[..]).collect();
        assert_eq!(said, ["x\u{fffd}\n", "stop\n", "end"]);
        let endless = std::io::repeat(b'a').take(3 * LONGEST_LINE);
        let pieces: Vec<_> = lines(std::io::BufReader::new(endless)).collect();
        assert_eq!(pieces.len(), 3);
    }

    #[test]
    fn a_quoted_cause_is_not_said_twice() {
        let error = Quoting {
            source: std::io::Error::other("no such file"),
        };
        let chain: [&(dyn std::error::Error + 'static); 2] = [&error, &error.source];
        assert_eq!(one_line(chain), "key.pem: no such file");
        assert_eq!(
            resolve("127.0.0.1:80"),
            Ok(SocketAddr::from(([127, 0, 0, 1], 80)))
        );
        assert!(resolve("127.0.0.1").is_err());
    }

    #[test]
    fn a_dispersion_has_a_unit_and_a_limit() {
        for (text, us) in [("50us", 50), ("0.2ms", 200), ("1s", 1_000_000)] {
            assert_eq!(dispersion(text), Ok(Duration::from_micros(us)));
        }
        for bad in ["", "50", "us", "-1ms", "0s", "2s", "nans", "50 minutes"] {
            assert!(dispersion(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn words_are_understood_whole_or_not_at_all() {
        for (line, meant) in [
            (" stop ", Some(Word::Stop)),
            ("reset", Some(Word::Reset)),
            ("pair", Some(Word::Pair(PAIRING_WINDOW))),
            ("pair 0.5s", Some(Word::Pair(Duration::from_millis(500)))),
            ("yes", Some(Word::Yes)),
            ("no", Some(Word::No)),
            ("", None),
            ("stop it", None),
            ("pair 0", None),
            ("pair 601s", None),
            ("pair soon", None),
            ("pair nan", None),
        ] {
            assert_eq!(Word::parse(line.trim(), ROBOT_WORDS), meant, "{line}");
        }
    }
}
