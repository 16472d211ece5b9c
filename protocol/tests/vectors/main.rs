//! `tests/vectors/wire_v1.json`: version 1 for every other implementation, as bytes and what they mean.
//!
//! The file is what this program says it is, byte for byte. To write it anew (until version 1 is released, and never after):
//! `TELEMIME_WRITE_VECTORS=1 cargo test -p telemime-protocol --test vectors`.

mod draw;
mod meaning;
mod messages;
mod reject;
mod skills;

use std::fmt::Write as _;
use std::path::PathBuf;

use serde_json::{Value, json};
use telemime_protocol::wire::v1;

/// Bytes of a kind, and what they are.
struct Vector {
    kind: &'static str,
    name: String,
    bytes: Vec<u8>,
    /// The value they decode to, or the name of the reason they are rejected for.
    means: Result<Value, &'static str>,
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn path() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/vectors/wire_v1.json")
}

/// One vector a line, so that a change shows as the lines that changed.
fn file() -> String {
    let vectors: Vec<Vector> = [
        messages::greetings(),
        messages::numbers(),
        messages::messages(),
        meaning::meanings(),
        skills::skills(),
        reject::rejects(),
    ]
    .into_iter()
    .flatten()
    .collect();
    let mut names: Vec<_> = vectors.iter().map(|v| (v.kind, v.name.as_str())).collect();
    names.sort_unstable();
    names.windows(2).for_each(|w| assert_ne!(w[0], w[1]));

    let note =
        "Made by protocol/tests/vectors. Once version 1 is released this file never changes again.";
    let mut out = format!(
        "{{\n\"protocol\": \"telemime/{}\",\n\"released\": {},\n\"note\": {},\n\"vectors\": [",
        v1::VERSION,
        v1::RELEASED,
        json!(note)
    );
    for (i, v) in vectors.iter().enumerate() {
        let mut line = json!({"kind": v.kind, "name": v.name, "hex": hex(&v.bytes)});
        match &v.means {
            Ok(value) => line["value"] = value.clone(),
            Err(name) => line["error"] = json!(name),
        }
        let comma = if i == 0 { "" } else { "," };
        write!(out, "{comma}\n{line}").expect("a string takes everything");
    }
    out.push_str("\n]\n}\n");
    out
}

#[test]
fn the_file_says_what_the_code_says() {
    let (path, made) = (path(), file());
    let known = std::fs::read_to_string(&path).unwrap_or_default();
    if known == made {
        return;
    }
    let frozen = known.contains("\"released\": true");
    if std::env::var_os("TELEMIME_WRITE_VECTORS").is_some() {
        assert!(
            !frozen,
            "version 1 is released: its vectors never change; a change of the wire is a new version"
        );
        std::fs::write(&path, made).unwrap();
        return;
    }
    let differs = known.lines().zip(made.lines()).find(|(a, b)| a != b);
    let remedy = if frozen {
        "version 1 is released: its bytes must not change"
    } else {
        "if the wire was meant to change: TELEMIME_WRITE_VECTORS=1 cargo test -p telemime-protocol --test vectors"
    };
    panic!("{}: {differs:#?}\n{remedy}", path.display());
}

/// Whoever takes "unreleased" out of the change log has to freeze the wire with it.
#[test]
fn a_release_freezes_the_wire() {
    let log = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../CHANGELOG.md");
    let log = std::fs::read_to_string(log).unwrap();
    let first = log
        .lines()
        .find(|l| l.starts_with("## [0.1.0]"))
        .expect("the change log has a section for 0.1.0");
    assert_eq!(
        v1::RELEASED,
        !first.contains("unreleased"),
        "`{first}`: wire::v1::RELEASED must say the same; then write the vectors once more"
    );
}
