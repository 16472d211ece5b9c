//! The page, as it is embedded.

/// A file of the page: its name, its type, its text.
pub(super) struct File {
    pub(super) name: &'static str,
    pub(super) kind: &'static str,
    pub(super) text: &'static str,
}

macro_rules! file {
    ($name:literal, $kind:literal) => {
        File {
            name: $name,
            kind: concat!($kind, "; charset=utf-8"),
            text: include_str!(concat!("page/", $name)),
        }
    };
}

/// The page is the first.
pub(super) const FILES: &[File] = &[
    file!("index.html", "text/html"),
    file!("style.css", "text/css"),
    file!("icon.svg", "image/svg+xml"),
    file!("arm.js", "text/javascript"),
    file!("drive.js", "text/javascript"),
    file!("fitts.js", "text/javascript"),
    file!("link.js", "text/javascript"),
    file!("main.js", "text/javascript"),
    file!("math.js", "text/javascript"),
    file!("panel.js", "text/javascript"),
    file!("plots.js", "text/javascript"),
    file!("render.js", "text/javascript"),
    file!("scene.js", "text/javascript"),
    file!("view.js", "text/javascript"),
];
