//! Two network namespaces and a veth pair between them, shaped by the kernel's netem.

use std::net::SocketAddr;
use std::process::{Command, Stdio};

use telemime_sim::link::LinkConfig;

use super::super::factor::Settings;
use super::Missing;

/// The robot's and the operator's addresses (RFC 5737's, for documentation: nobody's).
const ADDRESSES: [&str; 2] = ["198.51.100.1", "198.51.100.2"];

/// Where the robot listens.
const PORT: u16 = 4433;

/// What netem counts a packet's length from, B: rates here count from the IP header on.
const ETHERNET: i32 = 14;

/// Why there are no namespaces, or no link in them.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NetnsError {
    #[error("`{words}`: {why}")]
    Command { words: String, why: String },
    #[error(
        "`{0}` cannot be put into tc's words: traces and outages are known to the grounds virtual and loopback only"
    )]
    Link(String),
    #[error("an outage cannot be put on the ground netns; virtual and loopback can")]
    Outage,
}

fn sh(words: &[&str]) -> Result<(), NetnsError> {
    let wrong = |why: String| NetnsError::Command {
        words: words.join(" "),
        why,
    };
    let mut command = Command::new(words[0]);
    let done = command
        .args(&words[1..])
        .stdin(Stdio::null())
        .output()
        .map_err(|e| wrong(e.to_string()))?;
    if done.status.success() {
        return Ok(());
    }
    Err(wrong(
        String::from_utf8_lossy(&done.stderr).trim().to_owned(),
    ))
}

/// What is missing here, if anything is: tried out, on namespaces that are gone again when this returns. A wire that is not
/// `shaped` needs no netem.
pub(super) fn missing(shaped: bool) -> Result<(), Missing> {
    let programs: &[&str] = if shaped { &["ip", "tc"] } else { &["ip"] };
    for program in programs {
        let found = Command::new(program).arg("-V").output();
        found.map_err(|_| Missing(format!("`{program}` (of iproute2)")))?;
    }
    let spaces =
        Spaces::new().map_err(|e| Missing(format!("root, to make network namespaces ({e})")))?;
    if !shaped {
        return Ok(());
    }
    spaces
        .shape(0, &["delay".to_owned(), "1ms".to_owned()])
        .map_err(|e| Missing(format!("a kernel with netem, CONFIG_NET_SCH_NETEM ({e})")))
}

/// Two namespaces with a wire between them; gone when dropped.
struct Spaces {
    names: [String; 2],
}

impl Spaces {
    fn new() -> Result<Self, NetnsError> {
        use std::sync::atomic::{AtomicU32, Ordering};
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let id = std::process::id();
        let names = ["r", "o"].map(|end| format!("telemime-{id}-{n}-{end}"));
        let spaces = Self { names };
        let [robot, operator] = &spaces.names;
        sh(&["ip", "netns", "add", robot])?;
        sh(&["ip", "netns", "add", operator])?;
        sh(&[
            "ip", "-n", robot, "link", "add", "wire", "type", "veth", "peer", "name", "wire",
            "netns", operator,
        ])?;
        for (name, address) in spaces.names.iter().zip(ADDRESSES) {
            let address = format!("{address}/24");
            sh(&["ip", "-n", name, "address", "add", &address, "dev", "wire"])?;
            sh(&["ip", "-n", name, "link", "set", "lo", "up"])?;
            sh(&["ip", "-n", name, "link", "set", "wire", "up"])?;
        }
        Ok(spaces)
    }

    /// Shapes what leaves the robot (0) or the operator (1).
    fn shape(&self, end: usize, words: &[String]) -> Result<(), NetnsError> {
        let mut all = vec![
            "tc",
            "-n",
            &self.names[end],
            "qdisc",
            "add",
            "dev",
            "wire",
            "root",
            "netem",
        ];
        all.extend(words.iter().map(String::as_str));
        sh(&all)
    }
}

impl Drop for Spaces {
    fn drop(&mut self) {
        for name in &self.names {
            // One that was never made is not missed.
            let _ = sh(&["ip", "netns", "delete", name]);
        }
    }
}

/// Two namespaces and a shaped wire between them; gone when dropped.
pub(super) struct Namespaces(Spaces);

impl Namespaces {
    /// The links of `settings`, both ways.
    pub(super) fn new(settings: &Settings) -> Result<Self, NetnsError> {
        fits(settings)?;
        let spaces = Spaces::new()?;
        for (end, link) in [(0, &settings.down), (1, &settings.up)] {
            let words = words(link)?;
            if !words.is_empty() {
                spaces.shape(end, &words)?;
            }
        }
        Ok(Self(spaces))
    }

    /// What puts a command into the robot's namespace.
    pub(super) fn robot(&self) -> Vec<String> {
        self.inside(0)
    }

    /// What puts a command into the operator's namespace.
    pub(super) fn operator(&self) -> Vec<String> {
        self.inside(1)
    }

    fn inside(&self, end: usize) -> Vec<String> {
        ["ip", "netns", "exec", &self.0.names[end]]
            .map(str::to_owned)
            .to_vec()
    }

    /// Where the robot listens.
    pub(super) fn robot_addr(&self) -> SocketAddr {
        format!("{}:{PORT}", ADDRESSES[0])
            .parse()
            .expect("an address")
    }
}

/// Whether the kernel can be told the links of `settings`.
pub(super) fn fits(settings: &Settings) -> Result<(), NetnsError> {
    if settings.outage_s.is_some() {
        return Err(NetnsError::Outage);
    }
    for link in [&settings.up, &settings.down] {
        words(link)?;
    }
    Ok(())
}

/// The link in tc's words, one by one; none for a wire.
fn words(link: &LinkConfig) -> Result<Vec<String>, NetnsError> {
    if link.trace.is_some() || !link.outages.is_empty() {
        return Err(NetnsError::Link(link.to_string()));
    }
    if *link == LinkConfig::default() {
        return Ok(Vec::new());
    }
    let mut link = link.clone();
    if let Some(rate) = &mut link.rate {
        rate.overhead -= ETHERNET;
    }
    Ok(link
        .to_string()
        .split_whitespace()
        .map(str::to_owned)
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_becomes_tcs_words_or_is_refused() {
        let said = |text: &str| words(&text.parse().unwrap()).map(|words| words.join(" "));
        let delay = said("delay 100ms 10ms distribution normal loss 1%").unwrap();
        assert!(
            delay.starts_with("delay 100ms 10ms") && delay.contains("loss 1%"),
            "{delay}"
        );
        // Its own overhead takes the Ethernet header back out.
        assert!(said("rate 1mbit").unwrap().contains("-14"));
        assert_eq!(words(&LinkConfig::default()).unwrap(), Vec::<String>::new());
        assert!(said("delay 1ms outage 1s..2s").is_err());
    }
}
