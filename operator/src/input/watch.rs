//! The threads that look for the hand in depth frames.

use std::io::{self, Read};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use telemime_protocol::time::Stamp;

use super::read::Outlet;
use super::{Fault, Frame, Kind, Place, What};
use crate::depth::{Finder, Folder};

/// What a frame says of the hand.
fn seen(finder: &mut Finder, t_s: f64, pixels: &[u16]) -> What {
    match finder.find(t_s, pixels) {
        Some(found) => What::Frame(Frame {
            t_s: Some(t_s),
            hand: Some(Place {
                position: found.position,
                orientation: None,
                grip: None,
            }),
            engage: None,
        }),
        None => What::Dropped(Fault::new(Kind::Untracked, "no hand is away from the body")),
    }
}

/// Shows the frames of `folder` at `fps` as a camera would, from when `go` is dropped on.
pub(super) fn folder(
    folder: &Folder,
    mut finder: Finder,
    fps: f64,
    go: &mpsc::Receiver<()>,
    to: Outlet,
) {
    // Nothing is ever sent: it ends when the other end does.
    let _ = go.recv();
    let begun = to.now();
    for index in 0..folder.len() {
        let t_s = index as f64 / fps;
        wait(&to, begun.offset_by_secs(t_s));
        let what = match folder.frame(index) {
            Ok(pixels) => seen(&mut finder, t_s, &pixels),
            Err(e) => What::Dropped(Fault::new(Kind::Malformed, e.to_string())),
        };
        if !to.put(to.now(), what) {
            return;
        }
    }
    to.end("that was the last frame".into());
}

/// Waits until the clock of `to` shows `due`.
pub(super) fn wait(to: &Outlet, due: Stamp) {
    loop {
        let left_s = due.secs_since(to.now());
        if !(left_s > 0.0) {
            return;
        }
        thread::park_timeout(Duration::from_secs_f64(left_s));
    }
}

/// Reads frames of 16 bits a pixel, least byte first, row by row from the top, one after another.
pub(super) fn stream(mut source: impl Read, mut finder: Finder, to: Outlet) {
    let size = finder.camera().size();
    let mut bytes = vec![0; 2 * size.width * size.height];
    let mut pixels = vec![0; size.width * size.height];
    loop {
        let why = match fill(&mut source, &mut bytes) {
            Ok(n) if n == bytes.len() => None,
            Ok(0) => Some("nothing more to read".to_owned()),
            Ok(n) => Some(format!(
                "it was cut off {n} bytes into a frame of {}",
                bytes.len()
            )),
            Err(e) => Some(e.to_string()),
        };
        if let Some(why) = why {
            return to.end(why);
        }
        for (pixel, pair) in pixels.iter_mut().zip(bytes.chunks_exact(2)) {
            *pixel = u16::from_le_bytes([pair[0], pair[1]]);
        }
        let at = to.now();
        if !to.put(at, seen(&mut finder, at.0 as f64 * 1e-9, &pixels)) {
            return;
        }
    }
}

/// Reads until `bytes` is full or the source ends; how much there was.
fn fill(source: &mut impl Read, bytes: &mut [u8]) -> io::Result<usize> {
    let mut n = 0;
    while n < bytes.len() {
        match source.read(&mut bytes[n..]) {
            Ok(0) => break,
            Ok(more) => n += more,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(n)
}
