//! Recordings and descriptions that are public but not ours to ship.

use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Where the recordings are: `$TELEMIME_DATA`, or `shared` beside the workspace.
pub(crate) fn data() -> PathBuf {
    std::env::var_os("TELEMIME_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        PathBuf::from,
    )
}

/// The path below [`data`], or a loud note that the test proves nothing without it.
pub(crate) fn needs(relative: &str) -> Option<PathBuf> {
    let path = data().join(relative);
    if path.exists() {
        return Some(path);
    }
    skipped(format_args!(
        "{} is not there; set TELEMIME_DATA",
        path.display()
    ));
    None
}

/// Says loudly that this test proves nothing here, and why; `.ci/run` counts these lines.
pub(crate) fn skipped(why: impl std::fmt::Display) {
    // Straight to stderr: what a passing test prints by `eprintln!` nobody sees.
    let name = std::thread::current().name().unwrap_or_default().to_owned();
    let _ = writeln!(std::io::stderr(), "SKIPPED {name}: {why}");
}
