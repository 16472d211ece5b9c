//! Diagnostics as text or JSON on stderr, from a thread of their own: a reader that has stopped holds up nothing.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};
use tracing::{Level, dispatcher};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

use crate::cli::Printer;

/// What is logged unless `RUST_LOG` says otherwise: what the daemon does, and what its libraries warn of.
const USUAL: &str = "warn,foxglove=off,telemime=info";

/// How a log's lines are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Time, level and text.
    Text,
    /// A JSON object a line.
    Json,
}

/// A log that is being written.
#[derive(Debug)]
pub struct Logging(Printer);

impl Logging {
    /// Waits until everything is written, but not for a reader that does not read.
    pub fn finish(self) {
        self.0.flush();
    }
}

#[derive(Debug, Clone)]
struct Lines(Printer);

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // The formatter hands over whole events.
        self.0
            .say(String::from_utf8_lossy(bytes).trim_end().to_owned());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<'a> MakeWriter<'a> for Lines {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        self.clone()
    }
}

/// Starts logging to stderr, if a format was asked for or `RUST_LOG` is set; the first call of the process counts.
///
/// # Errors
/// One line, if `RUST_LOG` cannot be read or there is no thread to write from.
pub fn start(format: Option<Format>) -> anyhow::Result<Option<Logging>> {
    let wanted = std::env::var("RUST_LOG").ok().filter(|v| !v.is_empty());
    if (format.is_none() && wanted.is_none()) || dispatcher::has_been_set() {
        return Ok(None);
    }
    let filter = EnvFilter::try_new(wanted.as_deref().unwrap_or(USUAL)).map_err(|e| {
        anyhow::anyhow!("RUST_LOG: {e}; write for example telemime=debug,quinn=info")
    })?;
    // The subscriber lives as long as the process, and so does its printer.
    let (printer, _) = Printer::start_on_stderr()?;
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(false)
        .with_writer(Lines(printer.clone()));
    // Two threads that ask at once are one too many, and the other one's log is as good.
    let _ = match format.unwrap_or(Format::Text) {
        Format::Text => builder.try_init(),
        Format::Json => builder.json().try_init(),
    };
    Ok(Some(Logging(printer)))
}

/// Whether there is a log.
pub fn is_on() -> bool {
    dispatcher::has_been_set()
}

/// Something the person who started the daemon should know: into the log, or on stderr where there is none.
pub fn note(text: &str) {
    if is_on() {
        tracing::warn!(target: "telemime", "{text}");
    } else {
        eprintln!("note: {text}");
    }
}

/// Logs one of a daemon's events: its text, its name, and all of it as JSON. What comes many times a second is for
/// whoever asks for details.
pub fn event(event: &impl Serialize, text: &str, often: bool) {
    let wanted = if often {
        tracing::enabled!(target: "telemime", Level::DEBUG)
    } else {
        tracing::enabled!(target: "telemime", Level::INFO)
    };
    if !wanted {
        return;
    }
    let Ok(data) = serde_json::to_value(event) else {
        return;
    };
    let name = data["event"].as_str().unwrap_or_default();
    let text = text.trim_end().replace('\n', "; ");
    if often {
        tracing::debug!(target: "telemime", event = name, %data, "{text}");
    } else {
        tracing::info!(target: "telemime", event = name, %data, "{text}");
    }
}
