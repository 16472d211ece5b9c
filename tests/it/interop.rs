//! The second implementation of docs/protocol.md, in Python, against the same vectors. Its operator, which needs a package
//! and a network to fetch it from, runs in `tests/interop/run`.

use std::process::Command;

#[test]
fn the_python_implementation_agrees() {
    let python = |args: &[&str]| {
        Command::new("python3")
            .args(args)
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/interop"))
            .output()
    };
    let new_enough = "import sys; sys.exit(sys.version_info < (3, 11))";
    if !python(&["-c", new_enough]).is_ok_and(|out| out.status.success()) {
        crate::data::skipped("no python3 of 3.11 or newer here; tests/interop has not run");
        return;
    }
    let out = python(&["-m", "unittest"]).unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(
        out.status.success() && !said.contains("Ran 0 tests"),
        "{said}"
    );
}
