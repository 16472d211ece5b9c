//! Raw recordings to demonstrations, by the library and by the command.

use telemime_operator::ingest::{Cut, Imported, Options, import};
use telemime_sim::hand;

use crate::data::needs;

type Path3 = Vec<(f64, [f64; 3])>;

fn table(path: &Path3) -> String {
    let mut text = String::from("t,x,y,z\n");
    for (t, [x, y, z]) in path {
        text += &format!("{t},{x},{y},{z}\n");
    }
    text
}

fn cut(path: &Path3) -> Imported {
    let options = Options { cut: Cut::Repetitions, ..Options::default() };
    import(table(path).as_bytes(), &options).unwrap()
}

#[test]
fn measure() {
    // real: glitches found
    for set in ["demos/utd_mhad/a01_swipe_left", "demos/utd_mhad/a03_wave", "demos/utd_mhad/a09_circle_cw","demos/utd_mhad/a15_tennis_swing","demos/kard/a01_horizontal_arm_wave","demos/robottasks/pouring","demos/robottasks/openbox","demos/vr_hvr_ik/free_arm"] {
        let Some(dir) = needs(set) else { return };
        let (mut n, mut g, mut fast, mut gl) = (0, 0, 0.0f64, 0.0f64);
        let mut at = vec![];
        for e in std::fs::read_dir(dir).unwrap() {
            let p = e.unwrap().path();
            let i = import(&std::fs::read(&p).unwrap(), &Options::default()).unwrap();
            n += i.report.frames; g += i.report.glitches_s.len();
            fast = fast.max(i.report.fastest_kept_m_s);
            gl = gl.max(i.report.fastest_glitch_m_s);
            if !i.report.glitches_s.is_empty() { at.push((p.file_stem().unwrap().to_str().unwrap().to_owned(), i.report.glitches_s.clone())); }
        }
        println!("{set}: {g} of {n}; kept {fast:.1} m/s, glitch {gl:.1}  {at:?}");
    }
    // sim
    let (mut n, mut g) = (0, 0);
    for seed in 0..40 {
        for index in 0..3 {
            let i = import(table(&hand::swing(seed, index)).as_bytes(), &Options::default()).unwrap();
            n += i.report.frames; g += i.report.glitches_s.len();
        }
    }
    println!("sim: {g} of {n}");
    // segmentation: without rest
    let (mut hit, mut all, mut found, mut methods) = (0, 0, 0, vec![]);
    for seed in 0..20 {
        let path = hand::swing(seed, 0);
        let i = cut(&path);
        let c = &i.report.cuts[0];
        methods.push(format!("{:?}{}", c.method, i.takes.len()));
        let turns = hand::turns(seed, 0);
        let best = (0..2).map(|side| turns.iter().skip(side).step_by(2).filter(|t| c.at_s.iter().any(|a| (a - **t).abs() < 0.15)).count()).enumerate().max_by_key(|x| x.1).unwrap();
        hit += best.1; all += turns.iter().skip(best.0).step_by(2).count(); found += c.at_s.len();
    }
    println!("continuous: {hit} of {all} true, {found} found; {methods:?}");
}
