"""Names in STEP files: a text written out by hand, a square with a hole, in millimetres."""

import numpy as np
import pytest

from dolfinopt.mesh.geometry import read_shapes

pytestmark = pytest.mark.serial  # one rank shows all there is

# As programs write it: spaces and line ends anywhere, comments of a kind in strings.
SQUARE = """ISO-10303-21;
DATA;
#1=CARTESIAN_POINT('a; #2 (b)',(0.,0.,0.)); #2=CARTESIAN_POINT('',(40.,0.,0.));
#3=CARTESIAN_POINT('',(4.E+01,2.0E1,0.)); #4=CARTESIAN_POINT('',(0,20,0));
#5=CARTESIAN_POINT('',(1.5E+01,1.E+01,0.)); #6=CARTESIAN_POINT('centre',(10.,10.,0.));
#11 = VERTEX_POINT ( '', #1 ); #12=VERTEX_POINT('',#2); #13=VERTEX_POINT('',#3);
#14=VERTEX_POINT('',#4); #15=VERTEX_POINT('',#5);
#21=EDGE_CURVE('Inboard ',#11,
  #14,#90,.T.);
#22=EDGE_CURVE('it''s',#11,#12,#91,.T.); #23=EDGE_CURVE('',#12,#13,#92,.T.);
#24=EDGE_CURVE('',#13,#14,#93,.T.); #25=EDGE_CURVE('outboard',#15,#15,#94,.T.);
#31=ORIENTED_EDGE('',*,*,#21,.T.); #32=ORIENTED_EDGE('',*,*,#22,.T.);
#33=ORIENTED_EDGE('',*,*,#23,.T.); #34=ORIENTED_EDGE('',*,*,#24,.T.);
#35=ORIENTED_EDGE('',*,*,#25,.F.);
#41=EDGE_LOOP('',(#31,#32,#33,#34)); #42=EDGE_LOOP('',(#35));
#51=FACE_OUTER_BOUND('',#41,.T.); #52=FACE_BOUND('',#42,.T.);
#61=ADVANCED_FACE('passive',(#51,#52),#95,.T.);
#94=CIRCLE('hole',#96,5.); #96=AXIS2_PLACEMENT_3D('',#6,$,$);
#97=( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) );
ENDSEC;
"""
CORNERS = 1e-3 * np.array([[0, 0, 0], [40, 0, 0], [40, 20, 0], [0, 20, 0]])  # m
HOLE = 1e-3 * np.array([[15.0, 10.0, 0.0]])  # m
EVERYWHERE = np.concatenate([CORNERS, HOLE])


@pytest.mark.parametrize(
    ("points", "names"),
    [
        (CORNERS[[0, 3]], {"inboard"}),
        (CORNERS[[3, 0]], {"inboard"}),  # the other way round
        (CORNERS[[3, 0]] + 1e-9, {"inboard"}),
        (CORNERS[[3, 0]] + 1e-6, set()),
        (HOLE[[0, 0]], {"outboard"}),  # closed: begins where it ends
        (CORNERS[[1, 2]], set()),  # bears no name
        (CORNERS[[0, 2]], set()),  # no edge
        (CORNERS[[0, 0]], set()),  # one of its ends
    ],
)
def test_edges_are_found_by_their_ends(points, names):
    edges, _ = read_shapes(SQUARE)
    assert edges.names_at(points, EVERYWHERE) == names


def test_faces_are_found_by_all_their_vertices_in_any_unit():
    edges, faces = read_shapes(SQUARE)
    assert faces.names == ["passive"]
    assert faces.names_at(np.tile(EVERYWHERE, (2, 1)), EVERYWHERE) == {"passive"}
    assert faces.names_at(CORNERS, EVERYWHERE) == set()
    for factor in (1e3, 1.0 / 0.0254):
        assert edges.names_at(CORNERS[[0, 3]] * factor, EVERYWHERE * factor) == {"inboard"}
    edges, faces = read_shapes("ISO-10303-21;\nDATA;\nENDSEC;\n")
    assert edges.names == faces.names == []
    assert edges.names_at(CORNERS, EVERYWHERE) == set()
