//! What both daemons' command lines share.

use std::io::{self, BufRead, IsTerminal, Write};
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::thread;

use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{mpsc, watch};

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

/// Prints `event` as one line of JSON on stdout. A reader that has gone away is not our concern.
pub fn emit(event: &impl Serialize) {
    if let Ok(line) = serde_json::to_string(event) {
        let mut out = io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
    }
}

/// A word typed at a daemon's terminal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Word {
    /// `stop`: emergency stop.
    Stop,
    /// `reset`: leave the latched stop.
    Reset,
}

/// Resolves once the watch is true, or its sender is gone.
pub async fn told(quit: &mut watch::Receiver<bool>) {
    let _ = quit.wait_for(|quit| *quit).await;
}

/// Ctrl-C, SIGTERM, `quit`, or (if asked for) the end of stdin turn the watch true; `stop` and `reset` arrive
/// as words. stdin is read only when it is a terminal or `follow_stdin` is set.
///
/// # Errors
/// The system's, if signals cannot be caught.
pub fn listen(
    follow_stdin: bool,
) -> io::Result<(watch::Receiver<bool>, mpsc::UnboundedReceiver<Word>)> {
    let (quit_tx, quit) = watch::channel(false);
    let (word_tx, words) = mpsc::unbounded_channel();
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    let by_signal = quit_tx.clone();
    tokio::spawn(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        by_signal.send_replace(true);
    });
    if follow_stdin || io::stdin().is_terminal() {
        // A thread of its own, never joined: a blocking read cannot be cancelled, and ends with the process.
        thread::Builder::new().name("stdin".into()).spawn(move || {
            for line in io::stdin().lock().lines().map_while(Result::ok) {
                match line.trim() {
                    "stop" => drop(word_tx.send(Word::Stop)),
                    "reset" => drop(word_tx.send(Word::Reset)),
                    "quit" => break,
                    _ => eprintln!("stop, reset or quit?"),
                }
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
}
