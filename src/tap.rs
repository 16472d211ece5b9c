//! `telemime tap`: how old a sample is when the input hands it over.

use std::io::BufRead;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread;

use anyhow::{Context, bail};
use nalgebra::Vector3;
use serde::Serialize;
use telemime_endpoint::HostClock;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::input::{Kind, Units, frame};
use telemime_operator::tap::latency;

/// After the last press the hand's stop is still waited for, s.
const AFTER_S: f64 = 1.0;

/// Measure the input's latency from taps on a table.
///
/// Tap about ten times, fast and not in an even rhythm, and rest the hand for a moment after each. Either from a
/// recording and a file with the moments of the taps, on the recording's clock; or live: the tracker's samples
/// come on stdin as they are made (the lines that `telemime operator --input -` takes, or t,x,y,z; their own time is
/// not used), and you press Enter on the terminal with the other hand whenever the first one touches. The result is what `telemime operator --input-latency` wants.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Args {
    /// The recording (CSV: t,x,y,z), or - for live samples on stdin.
    recording: PathBuf,
    /// The moments of the taps, s, one a line (# begins a comment).
    #[arg(long, value_name = "FILE", required_unless_present = "live")]
    at: Option<PathBuf>,
    /// Live: samples on stdin, Enter on the terminal.
    #[arg(long, conflicts_with = "at")]
    live: bool,
    /// Live: end after so many presses.
    #[arg(long, value_name = "N", default_value_t = 12)]
    count: usize,
    /// Print one JSON object to stdout.
    #[arg(long)]
    json: bool,
}

/// Kept stable: fields are added, not changed.
#[derive(Debug, Serialize)]
struct Result {
    latency_ms: f64,
    bound_ms: f64,
    deviation_ms: f64,
    used: usize,
    taps: usize,
    stops: usize,
}

type Samples = Vec<(f64, Vector3<f64>)>;

/// Runs `telemime tap`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let (samples, taps) = match &args.at {
        Some(at) => (recorded(&args.recording)?, times(at)?),
        None if args.recording == Path::new("-") => live(args.count)?,
        None => bail!("--live reads the tracker's samples from stdin: write - instead of a file"),
    };
    let found = latency(&samples, &taps)?;
    let result = Result {
        latency_ms: found.latency_s * 1e3,
        bound_ms: found.bound_s * 1e3,
        deviation_ms: found.deviation_s * 1e3,
        used: found.used,
        taps: found.taps,
        stops: found.stops,
    };
    if args.json {
        say!("{}", serde_json::to_string(&result)?);
        return Ok(());
    }
    say!(
        "the input is {:.0} ms late, known to ±{:.0} ms (95 %): {} of {} taps, {} abrupt stops, single taps differ by {:.0} ms",
        result.latency_ms,
        result.bound_ms,
        result.used,
        result.taps,
        result.stops,
        result.deviation_ms
    );
    say!(
        "telemime operator --input-latency {:.0}ms",
        result.latency_ms
    );
    Ok(())
}

/// A recording on its own clock: [`Demonstration`] counts from its first sample, and the taps' times do not.
fn recorded(path: &Path) -> anyhow::Result<Samples> {
    let recording = Demonstration::read_csv(path)?;
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_path(path)?;
    let headers = reader.headers()?;
    let column = headers
        .iter()
        .position(|h| h.trim_start_matches('\u{feff}') == "t");
    let first = reader.records().next().transpose()?;
    let text = column.zip(first.as_ref()).and_then(|(at, row)| row.get(at));
    let zero_s: f64 = text
        .and_then(|text| text.parse().ok())
        .with_context(|| format!("{}: the first row has no time", path.display()))?;
    let samples = recording.samples().iter();
    Ok(samples.map(|s| (zero_s + s.t_s, s.position)).collect())
}

fn times(path: &Path) -> anyhow::Result<Vec<f64>> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut times = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.split('#').next().unwrap_or_default().trim();
        if line.is_empty() {
            continue;
        }
        let time = line.parse::<f64>().with_context(|| {
            format!(
                "{}, line {number}: `{line}` is not a time in s",
                path.display()
            )
        })?;
        times.push(time);
    }
    Ok(times)
}

enum Heard {
    Sample(Vector3<f64>),
    /// A line that is none.
    Other(String),
    Press,
    End,
}

fn live(count: usize) -> anyhow::Result<(Samples, Vec<f64>)> {
    let terminal = std::fs::File::open("/dev/tty")
        .context("no terminal to press Enter on: use a recording and --at FILE")?;
    let clock = HostClock::new();
    let (tx, heard) = mpsc::channel();
    let samples = tx.clone();
    // Threads of their own, never joined: a blocking read cannot be cancelled, and ends with the process.
    thread::Builder::new().spawn(move || {
        for line in std::io::stdin()
            .lock()
            .lines()
            .map_while(std::result::Result::ok)
        {
            let at = clock.now();
            let what = match sample(&line) {
                Some(Some(x)) => Heard::Sample(x),
                Some(None) => continue,
                None => Heard::Other(line),
            };
            if samples.send((at, what)).is_err() {
                return;
            }
        }
        let _ = samples.send((clock.now(), Heard::End));
    })?;
    thread::Builder::new().spawn(move || {
        let lines = std::io::BufReader::new(terminal).lines();
        for _ in lines.map_while(std::result::Result::ok) {
            if tx.send((clock.now(), Heard::Press)).is_err() {
                return;
            }
        }
    })?;
    eprintln!("tap, and press Enter with the other hand as the first one touches: {count} times");
    let begun = clock.now();
    let (mut samples, mut taps): (Samples, Vec<f64>) = (Vec::new(), Vec::new());
    for (at, what) in heard {
        let t_s = at.secs_since(begun);
        match what {
            Heard::Sample(x) if samples.last().is_none_or(|last| last.0 < t_s) => {
                samples.push((t_s, x));
            }
            Heard::Sample(_) => {}
            // A header.
            Heard::Other(_) if samples.is_empty() => {}
            Heard::Other(line) => bail!(
                "stdin: `{line}` is no sample: neither t,x,y,z nor a line of JSON with x, y and z"
            ),
            Heard::Press => {
                taps.push(t_s);
                eprintln!("{} of {count}", taps.len());
            }
            Heard::End => break,
        }
        let last = taps.last().copied().unwrap_or(t_s);
        if taps.len() >= count && t_s - last > AFTER_S {
            break;
        }
    }
    Ok((samples, taps))
}

/// The hand in a line as `telemime operator --input -` takes it, or `t,x,y,z[,…]`: `Some(None)` where there is none in it, `None` if it is neither.
fn sample(line: &str) -> Option<Option<Vector3<f64>>> {
    if !line.trim_start().starts_with('{') {
        return position(line).map(Some);
    }
    match frame::parse(line.as_bytes(), &Units::default()) {
        Ok(frame) => Some(frame.hand.map(|hand| hand.position)),
        Err(fault) => (fault.kind != Kind::Malformed).then_some(None),
    }
}

/// The position of a line `t,x,y,z[,…]`.
fn position(line: &str) -> Option<Vector3<f64>> {
    let mut numbers = line.split(',').map(|text| text.trim().parse::<f64>().ok());
    let _own_time = numbers.next()??;
    let x = Vector3::new(numbers.next()??, numbers.next()??, numbers.next()??);
    x.iter().all(|v| v.is_finite()).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_samples_or_not() {
        assert_eq!(
            position("12.5, 0.1,-0.2,2"),
            Some(Vector3::new(0.1, -0.2, 2.0))
        );
        assert_eq!(
            position("1,2,3,4,1,0,0,0"),
            Some(Vector3::new(2.0, 3.0, 4.0))
        );
        for line in ["t,x,y,z", "", "1,2,3", "1,2,3,nan", "1,2,3,x"] {
            assert_eq!(position(line), None, "{line}");
        }
    }

    #[test]
    fn what_an_operator_would_take_is_taken() {
        let at = |line| sample(line).flatten();
        assert_eq!(at("1,0.1,0.2,2"), Some(Vector3::new(0.1, 0.2, 2.0)));
        let point = r#"{"t":1,"x":0.1,"y":0.2,"z":2}"#;
        assert_eq!(at(point), Some(Vector3::new(0.1, 0.2, 2.0)));
        // No hand for a moment, and a pedal.
        for line in [r#"{"joints":{"head":[0,0,2]}}"#, r#"{"engage":true}"#] {
            assert_eq!(sample(line), Some(None), "{line}");
        }
        for line in ["{", r#"{"x":1}"#, "t,x,y,z"] {
            assert_eq!(sample(line), None, "{line}");
        }
    }
}
