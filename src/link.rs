//! `telemime link`: a bad link for any UDP.

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use telemime_endpoint::HostClock;
use telemime_endpoint::cli as shell;

use crate::cli::Ways;
use crate::relay::{Fate, Passage, Relay, RelayConfig};

/// A UDP relay that delays, loses, doubles, damages, reorders and throttles what passes.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// Where the operator sends to.
    #[arg(long, value_name = "ADDR")]
    listen: SocketAddr,
    /// Where the robot listens.
    #[arg(long, value_name = "HOST:PORT", value_parser = shell::resolve)]
    to: SocketAddr,
    #[command(flatten)]
    ways: Ways,
    /// Write every packet's fate to this CSV file.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

/// What became of one direction's packets so far.
#[derive(Debug, Default)]
struct Count {
    fates: [u64; Fate::ALL.len()],
    copies: u64,
    bytes: u64,
    delay_s: f64,
    out: u64,
}

impl Count {
    fn add(&mut self, passage: &Passage) {
        self.fates[passage.fate as usize] += 1;
        self.copies += u64::from(passage.copy);
        if let Some(out) = passage.out {
            self.bytes += passage.len_bytes as u64;
            self.delay_s += out.secs_since(passage.at);
            self.out += 1;
        }
    }

    fn of(&self, fate: Fate) -> u64 {
        self.fates[fate as usize]
    }

    /// `120 passed (100 ms), 3 lost, 1 doubled`: nothing that did not happen.
    fn line(&self) -> String {
        let mut line = format!("{} passed", self.out);
        if self.out > 0 {
            line += &format!(" ({:.1} ms)", self.delay_s / self.out as f64 * 1e3);
        }
        for (fate, name) in [
            (Fate::Lost, "lost"),
            (Fate::Overflow, "overflowed"),
            (Fate::Outage, "in outages"),
            (Fate::Overtook, "sent at once"),
            (Fate::Corrupted, "corrupted"),
            (Fate::Garbled, "with a broken header"),
            (Fate::Refused, "refused by the system"),
        ] {
            if self.of(fate) > 0 {
                line += &format!(", {} {name}", self.of(fate));
            }
        }
        if self.copies > 0 {
            line += &format!(", {} of them copies", self.copies);
        }
        line
    }
}

/// Runs `telemime link`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let mut record = match &args.record {
        None => None,
        Some(path) => {
            let mut out = csv::Writer::from_path(path)
                .with_context(|| format!("cannot write {}", path.display()))?;
            out.write_record(["mono_ns", "direction", "bytes", "delay_s", "fate", "copy"])?;
            Some(out)
        }
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (mut up, mut down) = (Count::default(), Count::default());
    let result = runtime.block_on(async {
        let (quit, _words) = shell::listen(false, "quit", || {})?;
        let config = RelayConfig {
            listen: args.listen,
            to: args.to,
            up: args.ways.up(),
            down: args.ways.down(),
            seed: args.ways.shape.link_seed,
        };
        let relay = Relay::bind(config, HostClock::new()).with_context(|| {
            format!(
                "cannot listen on {}: choose another --listen, or stop what uses it",
                args.listen
            )
        })?;
        say!(
            "relaying {} to {}; up: {}; down: {}; Ctrl-C ends it",
            relay.local_addr()?,
            args.to,
            args.ways.up(),
            args.ways.down()
        );
        // On a terminal only.
        let live = ProgressBar::new_spinner()
            .with_style(ProgressStyle::with_template("{msg}").expect("the template is constant"));
        let mut trouble = None;
        relay
            .run(quit, |passage: Passage| {
                let count = if passage.up { &mut up } else { &mut down };
                count.add(&passage);
                if !live.is_hidden() {
                    live.set_message(format!("up {}; down {}", up.line(), down.line()));
                }
                if let Some(out) = &mut record {
                    trouble = trouble.take().or(out.write_record(row(&passage)).err());
                }
            })
            .await;
        live.finish_and_clear();
        trouble.map_or(Ok(()), |e| Err(anyhow::Error::from(e)))
    });
    say!("up    {}", up.line());
    say!("down  {}", down.line());
    if let Some(mut out) = record {
        out.flush()?;
    }
    result
}

fn row(passage: &Passage) -> [String; 6] {
    let delay_s = passage.out.map(|t| t.secs_since(passage.at).to_string());
    [
        passage.at.0.to_string(),
        if passage.up { "up" } else { "down" }.to_owned(),
        passage.len_bytes.to_string(),
        delay_s.unwrap_or_default(),
        passage.fate.name().to_owned(),
        u8::from(passage.copy).to_string(),
    ]
}
