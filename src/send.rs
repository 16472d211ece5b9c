//! `telemime send`: a recording at true speed, as a tracker would send it.

use std::io::{self, Write};
use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::input::{Source, frame};
use tokio::time::{Instant, sleep_until};

/// While the hand rests, it is sampled so often, Hz.
const REST_HZ: f64 = 30.0;

/// The last frame lets go; datagrams may be lost.
const FAREWELLS: usize = 3;

/// Send a recording at true speed, as a tracker would: lines of JSON for `telemime operator --input`.
///
/// Each sample is one line with its own time (docs/input.md), written when it is due. With --engage the clutch is held
/// from the end of the rest to the last sample.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  telemime send wave.csv --engage | telemime operator --connect arm --input - --until-end
  telemime send wave.csv --to udp:127.0.0.1:5005 --engage")]
pub(crate) struct Args {
    /// The recording (CSV: t,x,y,z).
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Where to: standard output (-), or the operator's --input udp:…
    #[arg(long, value_name = "SINK", default_value = "-")]
    to: Source,
    /// Hold the clutch.
    #[arg(long)]
    engage: bool,
    /// Rest at the first position for this long first, s: one engages at rest.
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = rest)]
    rest: f64,
}

fn rest(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|s| (0.0..=60.0).contains(s))
        .ok_or_else(|| format!("`{text}`: write seconds, at most 60"))
}

enum Sink {
    Stdout,
    Udp(UdpSocket),
}

impl Sink {
    fn open(to: &Source) -> anyhow::Result<Self> {
        match to {
            Source::Stdin => Ok(Self::Stdout),
            Source::Udp(addr) => {
                let ours: SocketAddr = if addr.is_ipv4() {
                    ([0, 0, 0, 0], 0).into()
                } else {
                    ([0_u16; 8], 0).into()
                };
                let socket = UdpSocket::bind(ours).context("no socket to send from")?;
                let connected = socket.connect(addr);
                connected.with_context(|| format!("cannot send to {addr}"))?;
                Ok(Self::Udp(socket))
            }
            Source::DepthStdin | Source::DepthFolder(_) | Source::Evdev(_) => {
                bail!(
                    "a recording is sent to - or udp:ADDRESS:PORT; depth frames and gamepads are inputs only"
                )
            }
        }
    }

    /// Whether the other end still takes it.
    fn put(&self, line: &str) -> io::Result<bool> {
        match self {
            Self::Stdout => {
                let mut out = io::stdout().lock();
                match writeln!(out, "{line}").and_then(|()| out.flush()) {
                    Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(false),
                    done => done.map(|()| true),
                }
            }
            // A tracker does not ask who listens.
            Self::Udp(socket) => match socket.send(line.as_bytes()) {
                Err(e) if e.kind() == io::ErrorKind::ConnectionRefused => Ok(true),
                sent => sent.map(|_| true),
            },
        }
    }
}

/// The lines and when they are due, s.
fn lines(samples: &[Sample], rest_s: f64, engage: bool) -> Vec<(f64, String)> {
    let Some((first, last)) = samples.first().zip(samples.last()) else {
        return Vec::new();
    };
    let at = |t_s: f64, sample: &Sample, held: bool| {
        let sample = Sample { t_s, ..*sample };
        (t_s, frame::line(&sample, engage.then_some(held)))
    };
    let resting = (rest_s * REST_HZ) as usize;
    let rest = (0..resting).map(|i| at(i as f64 / REST_HZ, first, false));
    let motion = samples
        .iter()
        .map(|s| at(rest_s + s.t_s - first.t_s, s, true));
    let end_s = rest_s + last.t_s - first.t_s;
    let farewell = (1..=FAREWELLS).map(|i| at(end_s + i as f64 / REST_HZ, last, false));
    rest.chain(motion)
        .chain(farewell.filter(|_| engage))
        .collect()
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let recording = Demonstration::read_csv(&args.file)?;
    let sink = Sink::open(&args.to)?;
    let lines = lines(recording.samples(), args.rest, args.engage);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .build()
        .context("no runtime")?;
    runtime.block_on(async {
        let begun = Instant::now();
        for (due_s, line) in &lines {
            sleep_until(begun + Duration::from_secs_f64(*due_s)).await;
            match sink.put(line) {
                Ok(true) => {}
                Ok(false) => return Ok(()),
                Err(e) => bail!("{}: cannot be sent: {e}", args.file.display()),
            }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use telemime_operator::input::Units;

    use super::*;

    #[test]
    fn a_recording_is_sent_as_it_was_with_the_clutch_held_over_its_motion() {
        let samples: Vec<_> = (0..20)
            .map(|i| Sample::at(f64::from(i) * 0.02, Vector3::new(f64::from(i), 0.5, -1.0)))
            .collect();
        let sent = lines(&samples, 0.5, true);
        let frames: Vec<_> = sent
            .iter()
            .map(|(_, line)| frame::parse(line.as_bytes(), &Units::default()).unwrap())
            .collect();
        let held: Vec<_> = frames.iter().map(|f| f.engage.unwrap()).collect();
        let at = held.iter().position(|h| *h).unwrap();
        assert_eq!(at, 15);
        assert!(held[at..at + 20].iter().all(|h| *h) && !held[at + 20..].contains(&true));
        for (frame, sample) in frames[at..].iter().zip(&samples) {
            assert_eq!(frame.hand.unwrap().position, sample.position);
            assert!((frame.t_s.unwrap() - 0.5 - sample.t_s).abs() < 1e-12);
        }
        assert!(sent.windows(2).all(|w| w[1].0 > w[0].0));
        let plain = lines(&samples, 0.0, false);
        assert_eq!(plain.len(), 20);
        assert!(!plain[0].1.contains("engage"));
    }
}
