//! Is this host fit to drive, or to be driven? What is in order, what is not, and what to do.

mod host;
mod peer;

use std::path::PathBuf;

use serde::Serialize;
use telemime_endpoint::admin;
use telemime_endpoint::cli::say;

/// Look at this host, and the way to a robot: what is in order, what is not, and what to do.
///
/// Nothing is changed. With --connect the robot is greeted as an operator greets it: if nobody has authority over it, it
/// is ours for a moment, and nothing is asked to move.
///
/// Exit code 0, or 1 if something fails; a warning is no failure.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Args {
    /// Greet this robot too: where it is, or the name it was paired by.
    #[arg(long, value_name = "HOST:PORT|NAME")]
    connect: Option<String>,
    /// The operator's private key [default: ~/.config/telemime/operator.key].
    #[arg(long, value_name = "FILE")]
    identity: Option<PathBuf>,
    /// The robot's fingerprint, if it was not paired.
    #[arg(long, value_name = "FINGERPRINT")]
    peer: Option<String>,
    /// Who is trusted [default: ~/.config/telemime/peers].
    #[arg(long, value_name = "FILE")]
    peer_file: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Ok,
    Warn,
    Fail,
}

/// One thing looked at.
#[derive(Debug, Clone, Serialize)]
struct Finding {
    what: &'static str,
    verdict: Verdict,
    found: String,
    /// What to do, unless it is in order.
    remedy: Option<String>,
}

impl Finding {
    fn ok(what: &'static str, found: impl Into<String>) -> Self {
        Self {
            what,
            verdict: Verdict::Ok,
            found: found.into(),
            remedy: None,
        }
    }

    fn warn(what: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            verdict: Verdict::Warn,
            remedy: Some(remedy.into()),
            ..Self::ok(what, found)
        }
    }

    fn fail(what: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            verdict: Verdict::Fail,
            ..Self::warn(what, found, remedy)
        }
    }
}

#[derive(Serialize)]
struct Report {
    ok: bool,
    findings: Vec<Finding>,
}

/// Looks at everything and says so. Returns whether nothing failed.
///
/// # Errors
/// Stdout's, or no runtime.
pub(crate) fn run(args: &Args) -> anyhow::Result<bool> {
    let peer_file = args.peer_file.clone().unwrap_or_else(admin::peer_file);
    let mut findings = host::look(args.identity.as_deref(), &peer_file);
    if let Some(connect) = &args.connect {
        findings.extend(peer::greet(args, connect, &peer_file)?);
    }
    let ok = findings.iter().all(|f| f.verdict != Verdict::Fail);
    if args.json {
        say(&serde_json::to_string(&Report { ok, findings })?)?;
        return Ok(ok);
    }
    for Finding {
        what,
        verdict,
        found,
        remedy,
    } in &findings
    {
        let word = match verdict {
            Verdict::Ok => "ok  ",
            Verdict::Warn => "warn",
            Verdict::Fail => "FAIL",
        };
        say(&format!("{word}  {what}: {found}"))?;
        if let Some(remedy) = remedy {
            say(&format!("        {remedy}"))?;
        }
    }
    Ok(ok)
}
