mod clutch;
mod guarding;
mod serving;
mod wording;
